"""Where a file named by a person is found: ``hp3j.yaml`` works from any folder.

Order: the literal path, ``$FRICTID_HIL_PROFILES`` (folders joined by ``:``), ``./profiles``, the user's data folder,
and what the product ships. Nothing is ever written into the shipped folder.
"""

from __future__ import annotations

import difflib
import os
from importlib.resources import files
from pathlib import Path

import platformdirs

from frictid_hil.errors import ConfigError

_SUFFIXES = ("", ".yaml", ".yml")


def user_data_dir() -> Path:
    """The person's own folder: ``$XDG_DATA_HOME/frictid-hil``, else ``~/.local/share/frictid-hil``."""
    return platformdirs.user_data_path("frictid-hil")


def shipped_dir() -> Path:
    """The folder of shipped files: inside the installed package, or of the checkout in an editable install."""
    package = Path(str(files("frictid_hil")))
    installed = package / "_profiles"
    return installed if installed.is_dir() else package.parent / "profiles"


def places(folder: str = "") -> list[Path]:
    """The folders searched, in order, whether they exist or not; or a folder below each of them (``columns``)."""
    named = [Path(place) for place in os.environ.get("FRICTID_HIL_PROFILES", "").split(os.pathsep) if place]
    everywhere = [*named, Path("profiles"), user_data_dir() / "profiles", shipped_dir()]
    return [place / folder for place in everywhere]


def find(name: str | Path, *, folder: str = "", what: str = "robot file", beside: Path | None = None) -> Path:
    """The file a person means: a path or a bare name, suffix or not (``ConfigError``: where it was searched)."""
    if not str(name):
        raise ConfigError(f"no {what} named")
    literal = Path(name).expanduser()
    # Beside the file that mentions it comes first.
    candidates = [literal] if beside is None else [beside / literal, literal]
    if len(literal.parts) == 1:
        candidates += [place / literal for place in places(folder)]
    for candidate in candidates:
        for suffix in _SUFFIXES:
            path = candidate.with_name(candidate.name + suffix) if suffix else candidate
            if _exists(path) and not path.is_dir():
                return path
    if _exists(literal):
        raise ConfigError(f"{literal} is a folder; expected a {what}", where=str(literal))
    raise _not_found(literal, folder, what)


def available(folder: str = "") -> list[str]:
    """Names of the YAML files in the searched folders, sorted."""
    return sorted({path.name for place in places(folder) if place.is_dir() for path in place.glob("*.y*ml")})


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:
        return False


def _not_found(name: Path, folder: str, what: str) -> ConfigError:
    if len(name.parts) > 1:
        return ConfigError(f"no such {what}", where=str(name))
    names = available(folder)
    near = difflib.get_close_matches(name.name, names, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]}? " if near else ""
    searched = ", ".join(map(str, [Path.cwd(), *places(folder)]))
    return ConfigError(
        f"no {what} named {name}",
        cause=f"searched {searched}",
        next_step=f"{hint}there are: {', '.join(names) or 'none'}",
    )
