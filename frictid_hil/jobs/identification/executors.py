"""Where many independent tasks run: here, over processes, or over a dask.distributed cluster, behind one ``Executor``.

Results come in the order of the tasks. A task whose worker died, or whose answer could not be carried back, is told by
an error of its own, so that it spoils no other.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, wait
from typing import TypeVar

from frictid_hil.errors import FrictidError, HardwareError, UsageError

SERIAL_UP_TO = 3  # unless told, so few tasks are not worth a process

Task = TypeVar("Task")
Answer = TypeVar("Answer")


@contextlib.contextmanager
def executor(named: str | None, tasks: int) -> Iterator[Executor | None]:
    """Open the executor, None for this process (``UsageError``: no such; ``HardwareError``: no cluster there)."""
    if named is None and tasks <= SERIAL_UP_TO:
        yield None
        return
    kind, _, rest = (named or "processes:").partition(":")
    if kind == "processes" and (not rest or (rest.isdigit() and int(rest) > 0)):
        with ProcessPoolExecutor(int(rest) if rest else None) as pool:
            yield pool
    elif kind == "dask" and rest.startswith("//"):
        with _cluster(rest) as pool:
            yield pool
    else:
        raise UsageError(f"no executor {named!r}", next_step="processes:4, or dask://host:port")


def answers(
    pool: Executor | None, function: Callable[[Task], Answer], tasks: Sequence[Task]
) -> Iterator[Answer | FrictidError]:
    """Yield the answer to every task in order, or the error where it has none or its worker was lost."""
    if pool is None:
        yield from map(function, tasks)
        return
    futures: list[Future[Answer]] = [pool.submit(function, task) for task in tasks]
    for task, future in zip(tasks, futures, strict=True):
        try:
            answer = future.result()
        except FrictidError as wrong:
            yield wrong
            continue
        except Exception:  # whatever the cluster raises: a killed worker, a broken pipe, a missing package
            # A dying worker takes its neighbours with it, so each has a second try with nobody beside it.
            wait(futures)
            try:
                answer = pool.submit(function, task).result()
            except Exception as lost:
                yield FrictidError(
                    f"the worker gave no answer: {type(lost).__name__}: {lost}",
                    cause="the worker was killed (memory?), or runs another version",
                    next_step="identify this recording alone, without --executor",
                )
                continue
        yield answer


CONNECT_TIMEOUT = "10s"


@contextlib.contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError:
        raise UsageError(
            "dask:// needs the package distributed", next_step="pip install 'frictid-hil[cluster]'"
        ) from None
    try:
        client = Client(f"tcp:{address}", timeout=CONNECT_TIMEOUT)  # type: ignore[no-untyped-call, unused-ignore]
    except (OSError, ValueError) as unreachable:
        raise HardwareError(
            f"no cluster answers: {unreachable}",
            where=f"dask:{address}",
            next_step="start `dask scheduler` and `dask worker`, or use --executor processes:4",
        ) from None
    with client:
        pool = client.get_executor(pure=False)  # type: ignore[no-untyped-call, unused-ignore]
        try:
            yield pool
        finally:
            # Whoever wanted an answer has it; waiting for the rest may last for ever where a worker was killed.
            pool.shutdown(wait=False)
