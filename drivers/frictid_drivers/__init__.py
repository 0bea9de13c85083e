"""Drivers that ship with frictid-hil; each is found through the entry-point group ``frictid_hil.drivers``."""
