"""Actuators told position, velocity, gains and torque in one frame: Damiao, RobStride, CyberGear, CubeMars AK."""

from frictid_drivers.mit.driver import MitDriver

__all__ = ["MitDriver"]
