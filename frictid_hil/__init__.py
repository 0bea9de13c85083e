"""Identify, compensate and explain the friction of a robot joint on a CAN or serial bus."""

__version__ = "0.1.0"
