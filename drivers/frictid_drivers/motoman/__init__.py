"""MOTOMAN-class controllers on a serial line: host control, batch jobs, streaming."""

from frictid_drivers.motoman.driver import MotomanDriver

__all__ = ["MotomanDriver"]
