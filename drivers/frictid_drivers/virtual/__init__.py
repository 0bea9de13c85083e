"""A robot that exists only as numbers: one CiA-402 servo per joint on a CAN bus, with the simulated joint behind it."""

from frictid_drivers.virtual.driver import VirtualDriver

__all__ = ["VirtualDriver"]
