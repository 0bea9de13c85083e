"""One way to speak: results on stdout, the rest on stderr, one JSON object with ``--json``, honest exit codes."""

from __future__ import annotations

import inspect
import json
import logging
import math
import os
import shlex
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from functools import partial
from inspect import Parameter
from typing import Annotated, Any, NoReturn, Protocol, TypeVar

import typer
from rich.console import Console, RenderableType
from rich.table import Column, Table
from rich.text import Text

from frictid_hil.cli.options import SHARED
from frictid_hil.errors import Defect, FrictidError, Interrupted

EXIT_OF_OUTCOME = {"ok": 0, "refused": 2, "aborted": 1, "gate_failed": 5, "interrupted": 130}

READING = "profiles read anew for the store's index"
"""What takes long where the index of a store was lost, or its baseline changed."""

_COUNT_EVERY_S = 2.0

NOTIFY_TIMEOUT_S = 60.0  # a command of ``--notify`` may take this long

_plain_console = partial(Console, markup=False, emoji=False, highlight=False)

Result = Mapping[str, Any]
Asked = TypeVar("Asked")


@contextmanager
def _noted(console: Console) -> Iterator[None]:
    """What the library logs on its way, such as that it compiles, is printed for a person."""
    from rich.logging import RichHandler

    logger = logging.getLogger("frictid_hil")
    handler = RichHandler(console=console, show_time=False, show_level=False, show_path=False)
    logger.setLevel(logging.INFO)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def folding(*headings: str, whole: Collection[str] = (), title: str | None = None) -> Table:
    """A table that a narrow terminal folds and never cuts; columns named in ``whole`` are narrowed last, not folded."""
    columns = (Column(heading, overflow="fold", no_wrap=heading in whole) for heading in headings)
    return Table(*columns, title=title)


class Told(Protocol):
    """A typed result."""

    def to_json(self) -> dict[str, Any]:
        """The JSON of its verb, without the schema."""


@dataclass(frozen=True, slots=True)
class Output:
    """How this call was asked to speak, and what else it was asked."""

    as_json: bool = False
    quiet: bool = False
    given: Mapping[str, Any] = field(default_factory=dict)  # every other option and argument, by name

    def options(self, kind: Callable[..., Asked], **more: Any) -> Asked:
        """The value that a job takes: what was given under the names of its fields, and ``more``; else its defaults."""
        names = {one.name for one in fields(kind)}  # type: ignore[arg-type]  # a dataclass
        asked = {name: value for name, value in self.given.items() if name in names} | more
        return kind(**{n: tuple(v) if isinstance(v, list) else v for n, v in asked.items() if v is not None})

    @property
    def err(self) -> Console:
        """For people, on stderr; plain without a TTY."""
        return _plain_console(stderr=True, quiet=self.quiet or self.as_json, soft_wrap=not sys.stderr.isatty())

    @property
    def out(self) -> Console:
        """For results, on stdout; silent with ``--json``."""
        width = None if sys.stdout.isatty() else 120
        return _plain_console(quiet=self.as_json, width=width)

    def say(self, line: str) -> None:
        """A line of the result; a path in it is not cut in two."""
        self.out.print(line, soft_wrap=True)

    def tell(self, result: Result, *keys: str) -> None:
        """A line for each of these paths that the result has."""
        for key in keys:
            if result.get(key):
                self.say(f"{key}: {result[key]}")

    def table(
        self,
        headings: Sequence[str],
        rows: Iterable[Sequence[RenderableType]],
        whole: Sequence[str] = (),
        title: str | None = None,
    ) -> None:
        """A table of the result, see ``folding``."""
        table = folding(*headings, whole=whole, title=title)
        for row in rows:
            table.add_row(*row)
        self.out.print(table)

    def announce(self, verb: str, key: str, label: str) -> Callable[[str], None]:
        """Tells where a verb that runs on can be reached; whoever waits for it reads the first line."""

        def tell(place: str) -> None:
            told = {"schema": f"frictid.{verb}/1", "outcome": "ok", key: place}
            print(json.dumps(told) if self.as_json else f"{label}: {place}", flush=True)

        return tell

    def counting(self, doing: str) -> Callable[[int, int], None]:
        """Something to tell how many of how many are done: a line on stderr every two seconds, none for quick work."""
        console, told_s = self.err, time.monotonic()

        def count(done: int, of: int) -> None:
            nonlocal told_s
            if time.monotonic() - told_s >= _COUNT_EVERY_S:
                told_s = time.monotonic()
                console.print(f"{doing}: {done} of {of}")

        return count

    def run(
        self, verb: str, job: Callable[[], Result | Told], show: Callable[[Output, Result], None] | None = None
    ) -> NoReturn:
        """Call a job, print its result, leave with its exit code; ``verb`` names the schema (``frictid.<verb>/1``)."""
        try:
            with _noted(self.err):
                done = job()
            result = dict(done) if isinstance(done, Mapping) else done.to_json()
        except FrictidError as error:
            self._fail(verb, error)
        except BrokenPipeError:
            os._exit(1)
        except typer.Exit:  # a verb that has printed its own result
            raise
        except Exception as error:  # a job that nobody watches must end with a line as well
            traceback.print_exc()
            self._fail(verb, Defect.of(error))
        except KeyboardInterrupt:
            self._fail(verb, Interrupted("interrupted"))
        result.setdefault("outcome", "ok")
        code = int(result.pop("exit_code", EXIT_OF_OUTCOME[str(result["outcome"])]))
        self._tell({"schema": f"frictid.{verb}/1", **result})
        if self.as_json:
            _print_json({"schema": f"frictid.{verb}/1", **result})
        elif show is not None and not result.get("dry_run"):
            show(self, result)
        error_text = result.get("error")
        if code and isinstance(error_text, Mapping) and not self.as_json:
            self._explain(error_text)
        raise typer.Exit(code)

    def refuse(self, verb: str, error: FrictidError) -> NoReturn:
        """End a command that never began, as ``run`` ends one that failed."""
        try:
            self._fail(verb, error)
        except typer.Exit as ended:
            sys.exit(ended.exit_code)

    def _fail(self, verb: str, error: FrictidError) -> NoReturn:
        described = error.to_json()
        failure = {"schema": f"frictid.{verb}/1", "outcome": error.outcome, "error": described}
        self._tell(failure)
        if self.as_json:
            _print_json(failure)
        self._explain(described)
        raise typer.Exit(error.exit_code)

    def _tell(self, result: Mapping[str, Any]) -> None:
        """Give the result to the command of ``notify``; what becomes of that changes no result."""
        notify = self.given.get("notify")
        if notify is None:
            return
        text = _json_text(result) + "\n"
        try:
            told = subprocess.run(
                shlex.split(notify),
                input=text,
                text=True,
                stdout=sys.stderr,
                timeout=NOTIFY_TIMEOUT_S,
                check=False,
            )
            wrong = f"ended with {told.returncode}" if told.returncode else ""
        except (OSError, ValueError, subprocess.SubprocessError) as error:
            wrong = str(error)
        if wrong:
            print(f"warning: --notify {notify}: {wrong}", file=sys.stderr)

    def _explain(self, error: Mapping[str, Any]) -> None:
        # Errors are never quiet, and never wrapped in the middle of a path.
        console = _plain_console(stderr=True, soft_wrap=True)
        where = f"{error['where']}: " if error.get("where") else ""
        console.print(Text.assemble(("error:", "bold red"), f" {where}{error.get('what', '')}"))
        if error.get("cause"):
            console.print(f"  likely cause: {error['cause']}")
        if error.get("next_step"):
            console.print(f"  next step: {error['next_step']}")


Verb = TypeVar("Verb", bound=Callable[..., Result | Told])


def takes(**own: Any) -> Callable[[Verb], Verb]:
    """The options and arguments that a verb does not share with others, by the name of their parameter."""

    def add(function: Verb) -> Verb:
        vars(function)["takes"] = own
        return function

    return add


def verb(
    app: typer.Typer, name: str, show: Callable[[Output, Result], None] | None = None, schema: str = ""
) -> Callable[[Verb], Verb]:
    """Make a verb of a function of ``Output`` and its own options; ``show`` prints its result for a person."""

    def add(function: Verb) -> Verb:
        _, *taken = inspect.signature(function, eval_str=True).parameters.values()
        options = {**SHARED, **vars(function).get("takes", {})}
        parameters = [
            one.replace(kind=Parameter.KEYWORD_ONLY, annotation=Annotated[one.annotation, options[one.name]])
            for one in taken
        ]
        parameters += [
            Parameter(n, Parameter.KEYWORD_ONLY, default=False, annotation=Annotated[bool, options[n]])
            for n in ("as_json", "quiet")
        ]

        def call(*, as_json: bool, quiet: bool, **given: Any) -> None:
            output = Output(as_json, quiet, given)
            output.run(schema or name, lambda: function(output, **given), show)

        vars(call)["__signature__"] = inspect.Signature(parameters)
        app.command(name, help=inspect.getdoc(function))(call)
        return function

    return add


def _print_json(value: Mapping[str, Any]) -> None:
    sys.stdout.write(_json_text(value) + "\n")
    sys.stdout.flush()


def _json_text(value: Mapping[str, Any]) -> str:
    """One line; looks for NaN only where there is one, because a history may hold half a million figures."""
    try:
        return json.dumps(value, allow_nan=False, default=_jsonable)
    except ValueError:
        return json.dumps(_finite(value), default=_jsonable)


def _finite(value: Any) -> Any:
    """NaN and infinities become null: JSON has neither."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value


def _jsonable(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    if hasattr(value, "tolist"):
        return _finite(value.tolist())
    return str(value)
