"""Executors of independent tasks: this process, worker processes, or a dask.distributed cluster. One interface."""

import importlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from itertools import count
from typing import Any, TypeVar

from processing.computing.threads import THREADS_VARIABLE
from processing.errors import ProcessError

Task = TypeVar("Task")
Result = TypeVar("Result")


def gather(
    pool: Executor,
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    progress: Callable[[int, int], None] | None = None,
) -> list[Result | Exception]:
    """Results in the order of the tasks; for one that failed its error, and the others are done all the same."""
    done = count(1)

    def tick(_: object) -> None:
        if progress:
            progress(next(done), len(tasks))

    def outcome(future: Future[Result] | Exception) -> Result | Exception:
        try:
            return future if isinstance(future, Exception) else future.result()
        except Exception as error:  # noqa: BLE001  # whatever is wrong with one task
            return error

    futures: list[Future[Result] | Exception] = []
    for task in tasks:
        try:
            future = pool.submit(work, task)
            future.add_done_callback(tick)
            futures.append(future)
        except Exception as error:  # noqa: BLE001  # the workers are gone
            futures.append(error)
    return [outcome(future) for future in futures]


class _Here(Executor):
    """Runs each task when it is submitted, in the calling thread."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except BaseException as error:
            if not isinstance(error, Exception):
                raise
            future.set_exception(error)
        return future


@contextmanager
def executor(workers: int = 1, scheduler: str | None = None) -> Iterator[Executor]:
    """An executor for the block.

    Parameters
    ----------
    workers : processes on this machine; 1 works in this one.
    scheduler : address of a dask.distributed scheduler, e.g. "tcp://host:8786"; its workers need this program
        and the same paths.

    Raises
    ------
    ProcessError : dask.distributed is not installed, or no scheduler answers.
    """
    if scheduler is not None:
        yield from _cluster(scheduler)
    elif workers <= 1:
        yield _Here()
    else:
        import multiprocessing

        # Each worker has a core of its own: threads inside would only wait for one another.
        with ProcessPoolExecutor(
            workers, mp_context=multiprocessing.get_context("spawn"), initializer=_one_thread
        ) as pool:
            yield pool


def _one_thread() -> None:
    os.environ[THREADS_VARIABLE] = "1"


def _cluster(scheduler: str) -> Iterator[Executor]:
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise ProcessError(
            "--scheduler needs dask.distributed, which is not installed. Install umov[cluster], or use --workers."
        ) from error
    try:
        client = distributed.Client(scheduler, timeout="10s", set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ProcessError(
            f"no dask scheduler answers at {scheduler} ({error}). Start one with `dask scheduler`, or use --workers."
        ) from error
    with client:
        yield client.get_executor()
