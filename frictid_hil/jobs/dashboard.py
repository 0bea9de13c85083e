"""``frictid-hil dashboard``: pages of the store, the runs and a run as it moves, on this computer. It moves nothing."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from frictid_hil.errors import FrictidError, HardwareError, UsageError
from frictid_hil.jobs.report import NIGHT_PAGE, page_of
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.recording.mcap_reader import read_mcap
from frictid_hil.recording.samples import Samples
from frictid_hil.report.dashboard import home_page, live_html
from frictid_hil.report.pages import Page, html_of, plotly
from frictid_hil.runs.folder import kept_joints, load_manifest, parts_of
from frictid_hil.units import degrees

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

_SHOWN_S = 10.0
_MOST_POINTS = 700
_REPORT = "report.html"
_LOOPBACK = ("localhost", "127.0.0.1", "[::1]")


def serve(runs: Path, store: ProfileStore, port: int, announce: Callable[[str], None]) -> None:
    """Answer on loopback, at an address that is announced, until Ctrl-C (``UsageError``, ``HardwareError``)."""
    try:
        import uvicorn
    except ImportError:
        raise UsageError(
            "the dashboard needs starlette and uvicorn", next_step="pip install 'frictid-hil[dashboard]'"
        ) from None
    with socket.socket() as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind(("127.0.0.1", port))
        except OSError as error:
            raise HardwareError(
                f"port {port} of 127.0.0.1 cannot be had: {error.strerror}", next_step="choose another with --port"
            ) from None
        announce(f"http://127.0.0.1:{port}/")
        config = uvicorn.Config(application(runs, store), log_level="error", access_log=False)
        with suppress(KeyboardInterrupt):
            uvicorn.Server(config).run(sockets=[listening])


def application(runs: Path, store: ProfileStore) -> Starlette:
    """The pages as an ASGI application; it only reads, and answers to the names of this computer alone."""
    from starlette.applications import Starlette
    from starlette.middleware import Middleware
    from starlette.middleware.trustedhost import TrustedHostMiddleware
    from starlette.responses import FileResponse, HTMLResponse, JSONResponse
    from starlette.responses import Response as Plain
    from starlette.routing import Route

    def shown(page: Page, status: int = 200) -> Response:
        return HTMLResponse(html_of(page), status_code=status)

    def not_found(words: str) -> Response:
        return shown(Page("Not found", words, []), 404)

    def home(_: Request) -> Response:
        newest = {name: store.history(name, 1) for name in store.robots()}
        robots = {name: profiles[-1].created_utc if profiles else "" for name, profiles in newest.items()}
        found = [(address, load_manifest(path)) for address, path in runs_in(runs).items()]
        found.sort(key=lambda run: str(run[1]["started_utc"]), reverse=True)
        return shown(home_page(robots, found))

    def robot(request: Request) -> Response:
        addresses = {path.resolve(): address for address, path in runs_in(runs).items()}

        def night(run: Path) -> str:
            return f"/runs/{addresses[run]}/{NIGHT_PAGE}" if run in addresses else ""

        try:
            return shown(page_of(store, request.path_params["name"], night))
        except FrictidError as error:
            return not_found(str(error))

    def run(request: Request) -> Response:
        address = request.path_params["address"]
        address, _, wanted = address.rpartition("/") if address.endswith((NIGHT_PAGE, "/now")) else (address, "", "")
        # An address is looked up among the runs that are there: it never becomes a path.
        if (path := runs_in(runs).get(address)) is None:
            return not_found(f"There is no run {address} under {runs}.")
        manifest = load_manifest(path)
        if wanted == "now":
            return JSONResponse(now(path, manifest))
        if (page := path / (wanted or _REPORT)).exists():
            return FileResponse(page, media_type="text/html")
        if manifest["outcome"] is None:
            return HTMLResponse(live_html(address, manifest))
        return shown(_without_report(manifest))

    def script(_: Request) -> Response:
        return Plain(plotly(), media_type="text/javascript")

    return Starlette(
        routes=[
            Route("/", home),
            Route("/robots/{name}", robot),
            Route("/runs/{address:path}", run),
            Route("/plotly.js", script),
        ],
        middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=_LOOPBACK)],
    )


def runs_in(folder: Path) -> dict[str, Path]:
    """Every run below a folder, by its relative address; links out of the folder are not followed."""
    root = folder.resolve()
    found = {}
    for manifest in sorted([*folder.glob("*/manifest.json"), *folder.glob("*/*/manifest.json")]):
        if not manifest.resolve().is_relative_to(root):
            continue
        try:
            load_manifest(manifest.parent)
        except FrictidError:
            continue
        found[manifest.parent.relative_to(folder).as_posix()] = manifest.parent
    return found


def now(run: Path, manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The answer to the live page: the newest seconds of the joint that moves most, and the joints that are done."""
    told: dict[str, Any] = {
        "ended": manifest["outcome"] is not None,
        "told": "no samples yet",
        "time_s": [],
        "joints": [
            {"name": name, "gates": ", ".join(failed) or "passed"}
            for name, (profile, _) in kept_joints(run).items()
            for failed in [[gate.name for gate in profile.gates if not gate.passed]]
        ],
    }
    if (samples := _moving(run)) is None:
        return told
    scale = 1e3 if samples.prismatic else degrees(1.0)
    every = max(1, -(-samples.time_s.size // _MOST_POINTS))
    torque = samples.torque_nm if samples.torque_nm is not None else np.zeros_like(samples.position_rad)
    return told | {
        "told": f"Joint {samples.joint}, {samples.time_s[-1]:.0f} s of run time.",
        "time_s": _plain(samples.time_s[::every]),
        "position": _plain(scale * samples.position_rad[::every]),
        "torque": _plain(torque[::every]),
        "position_unit": "mm" if samples.prismatic else "deg",
        "torque_unit": "N" if samples.prismatic else "N m",
    }


def _moving(run: Path) -> Samples | None:
    """The last seconds of the joint that moves most; None while there are none."""
    parts = parts_of(run)
    if not parts:
        return None
    try:
        newest = [one for one in read_mcap(parts[-1][0]) if one.time_ns.size > 1]
    except FrictidError:  # the first chunk is still being written
        return None
    last = [one.select(one.time_ns >= one.time_ns[-1] - round(_SHOWN_S * 1e9)) for one in newest]
    return max(last, key=lambda one: float(np.ptp(one.position_rad)), default=None)


def _without_report(manifest: Mapping[str, Any]) -> Page:
    error = manifest.get("error") or {}
    outcome = str(manifest["outcome"]).replace("_", " ")
    headline = f"The run ended as {outcome}{': ' + error['what'] if error.get('what') else ''}. It has no report."
    return Page(f"{manifest['verb']} of {manifest['robot']}", headline, [])


def _plain(values: np.ndarray[Any, np.dtype[Any]]) -> list[float | None]:
    return [round(float(value), 6) if np.isfinite(value) else None for value in values]
