"""CiA-402 drives on any python-can bus: the host driver, and the codec that reads its frames again from a log."""

from frictid_drivers.cia402.driver import Cia402Driver
from frictid_drivers.cia402.frame_map import FrameMap

__all__ = ["Cia402Driver", "FrameMap"]
