"""What can stop a measurement, besides a device: the plan, the disc, the person at the bench."""

import traceback
from pathlib import Path
from typing import Any

from drivers.errors import DeviceError
from processing.errors import ProcessError


class AcquisitionError(Exception):
    """A run cannot start or go on; the message says what was asked, what came back and what to do.

    Examples
    --------
    >>> from acquisition import AcquisitionError, MeasurementPlan, load_rig, take_capture
    >>> try:
    ...     take_capture(MeasurementPlan(mode="no_such_mode"), load_rig("rig.yaml"), "captures")
    ... except AcquisitionError as error:
    ...     "no_such_mode" in str(error)
    True
    """


class PlanRefused(AcquisitionError):
    """The check of the plan failed; nothing was moved. Holds every failure."""

    def __init__(self, failures: list[str]) -> None:
        super().__init__("the plan is refused, nothing was moved:\n" + "\n".join(f"  - {f}" for f in failures))
        self.failures = failures

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.failures,)


class RunFailed(AcquisitionError):
    """A run ended early; the partial file holds every state that was done."""


class Unforeseen(RunFailed):
    """An unforeseen error ended a run: the program has a fault. Holds the traceback as text."""

    def __init__(self, error: BaseException) -> None:
        lines = traceback.extract_tb(error.__traceback__)
        where = f" ({Path(lines[-1].filename).name}, line {lines[-1].lineno})" if lines else ""
        super().__init__(
            f"an unforeseen error ended the run: {type(error).__name__}: {error}{where}. The light was shut and the "
            "axes stopped; continue with the same command, or --resume. Please report the traceback in the log."
        )
        self.trace = "".join(traceback.format_exception(error))


def as_run_error(error: Exception) -> Exception:
    """The error itself where it is one that a run may end with, else an `Unforeseen` that holds it."""
    return error if isinstance(error, AcquisitionError | DeviceError | ProcessError) else Unforeseen(error)


class InterlockOpened(RunFailed):
    """An interlock ended the run: an operator has to look before it continues."""


class Stopped(AcquisitionError):
    """The person at the bench asked for the end (Ctrl-C or the stop button)."""


class Differs(AcquisitionError):
    """A file was begun with another set-up than the present one. Holds every difference."""

    def __init__(self, subject: str, changes: list[str]) -> None:
        super().__init__(
            f"{subject} was begun with another set-up:\n"
            + "\n".join(f"  - {line}" for line in changes)
            + "\nNothing was moved or changed. Restore the first set-up, or start a separate file with --as-new."
        )
        self.subject, self.changes = subject, changes

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.subject, self.changes)
