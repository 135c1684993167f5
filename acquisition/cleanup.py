"""Cleanup that keeps going: every step runs, the first failure is reported and the others are attached to it.

And calls that a disc can hold: they run in a thread, so that the one that measures can be interrupted meanwhile.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable
from typing import TypeVar

from acquisition.errors import AcquisitionError

log = logging.getLogger(__name__)

Step = tuple[str, Callable[[], object]]
T = TypeVar("T")

#: Longest wait for a disc that takes nothing, and how often a waiting thread can be interrupted.
DISC_S = 30.0
SLICE_S = 0.1


def run_all(steps: Iterable[Step]) -> Exception | None:
    """Run every step, whatever the others do; return the first failure with notes of the others, or None."""
    first: Exception | None = None
    for what, step in steps:
        try:
            step()
        except Exception as error:  # noqa: BLE001 - a clean-up boundary: no failure may keep the other steps from running
            log.error("clean-up: %s failed: %s", what, error)
            if first is None:
                first = error
                first.add_note(f"while cleaning up: {what}")
            else:
                first.add_note(f"also failed while cleaning up: {what}: {error}")
    return first


def on_disc(what: str, work: Callable[[], T], patience_s: float = DISC_S) -> T:
    """Do something on the disc; a disc that hangs holds a thread of its own, and never the caller.

    Raises
    ------
    AcquisitionError
        The disc has not answered in `patience_s`; what was begun ends when it answers.
    """
    done: list[T] = []
    failed: list[BaseException] = []

    def run() -> None:
        try:
            done.append(work())
        except BaseException as error:  # noqa: BLE001 - raised again by the caller
            failed.append(error)

    thread = threading.Thread(target=run, name=f"disc, {what}", daemon=True)
    try:
        thread.start()
    except RuntimeError:
        # No thread to be had: a disc that is well takes it from here.
        return work()
    end_s = time.monotonic() + patience_s
    while thread.is_alive() and time.monotonic() < end_s:
        thread.join(SLICE_S)
    if failed:
        raise failed[0]
    if not done:
        raise AcquisitionError(
            f"{what}: the disc has not answered for {patience_s:g} s. The light is off. This program ends when the "
            "disc answers; then go on with the same command, or --resume."
        )
    return done[0]
