"""Identify, compensate and explain the friction of a robot joint on a CAN or serial bus.

``import frictid_hil as fh`` gives ``fh.load_robot``, ``fh.calibrate``, ``fh.identify``, ``fh.load_profile``,
``fh.load_recording``, ``fh.diagnose`` and ``fh.plot``; they are loaded when first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from frictid_hil.version import __version__ as __version__

if TYPE_CHECKING:
    from frictid_hil.api import calibrate as calibrate
    from frictid_hil.api import diagnose as diagnose
    from frictid_hil.api import identify as identify
    from frictid_hil.api import load_profile as load_profile
    from frictid_hil.api import load_recording as load_recording
    from frictid_hil.api import load_robot as load_robot
    from frictid_hil.api import plot as plot

_OFFERED = ("calibrate", "diagnose", "identify", "load_profile", "load_recording", "load_robot", "plot")


def __getattr__(name: str) -> Any:
    if name in _OFFERED:
        return getattr(import_module("frictid_hil.api"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*globals(), *_OFFERED]
