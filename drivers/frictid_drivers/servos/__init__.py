"""Hobby and research servos on one serial line: Feetech STS and SCS, Dynamixel X."""

from frictid_drivers.servos.driver import ServoDriver

__all__ = ["ServoDriver"]
