"""The version of this program, as it is installed."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("frictid-hil")
except PackageNotFoundError:  # run from a checkout that was never installed
    __version__ = "0+unknown"
