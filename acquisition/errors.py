"""What can stop a measurement, besides a device: the plan, the disc, the person at the bench."""

from __future__ import annotations


class AcquisitionError(Exception):
    """A run cannot start or go on; the message says what was asked, what came back and what to do."""


class PlanRefused(AcquisitionError):
    """The check of the plan failed; nothing was moved. Holds every failure."""

    def __init__(self, failures: list[str]) -> None:
        super().__init__("the plan is refused, nothing was moved:\n" + "\n".join(f"  - {f}" for f in failures))
        self.failures = failures


class RunFailed(AcquisitionError):
    """A run ended early; the partial file holds every state that was done."""


class InterlockOpened(RunFailed):
    """An interlock ended the run: somebody has to look before it goes on."""


class Stopped(AcquisitionError):
    """The person at the bench asked for the end (Ctrl-C or the stop button)."""


class Differs(AcquisitionError):
    """What is there was begun with something else than what would go on now. Holds every difference."""

    def __init__(self, what: str, found: list[str]) -> None:
        super().__init__(
            f"{what} was begun with something else:\n"
            + "\n".join(f"  - {line}" for line in found)
            + "\nNothing was moved or changed. Go on with what began it, or keep what comes now apart with --as-new."
        )
        self.found = found
