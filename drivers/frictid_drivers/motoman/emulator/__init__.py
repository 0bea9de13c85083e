"""A serial controller that is not there: bytes in, bytes out, six simulated joints behind it.

Written against the bytes of the documentation, not against the driver: no codec is shared, so that the two can only
agree by both being right. The core runs in any time it is given (``Emulator``); ``pty`` puts it on a real terminal.
"""

from frictid_drivers.motoman.emulator.build import build
from frictid_drivers.motoman.emulator.pty import serve

__all__ = ["build", "serve"]
