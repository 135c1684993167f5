"""The person at the bench: changes the sample, the filter or the camera when asked to."""

import select
import sys
from collections.abc import Callable

from acquisition.capture.plan import MeasurementPlan
from acquisition.errors import AcquisitionError, Stopped
from acquisition.stop_request import StopRequest

#: Ctrl-C is noticed within this time while a question waits.
LOOK_S = 0.1


class Operator:
    """Asks for changes on the console; with `yes` every question is taken as answered.

    Parameters
    ----------
    tell : prints a line.
    simulated : a simulated rig is changed by the program itself.
    """

    def __init__(self, tell: Callable[[str], None], stop: StopRequest, yes: bool, simulated: bool) -> None:
        self._tell = tell
        self._stop = stop
        self._yes = yes
        self._simulated = simulated
        self._previous_plan: MeasurementPlan | None = None

    def prepare(self, plan: MeasurementPlan, *, source_selects: bool = False) -> list[str]:
        """Have done what this capture needs and the one before did not; returns what was changed.

        Parameters
        ----------
        source_selects : the source sees to its wavelength itself, even if only by asking.

        Raises
        ------
        AcquisitionError
            There is nobody to ask: no terminal and no --yes.
        Stopped
            Ctrl-C while waiting.
        """
        before, self._previous_plan = self._previous_plan, plan
        changes = []
        if before is None or before.sample != plan.sample:
            changes.append(f"place the sample: {plan.sample.name or plan.sample.kind}")
        if not source_selects and (before is None or before.wavelength_nm != plan.wavelength_nm):
            changes.append(f"set the source to {plan.wavelength_nm:g} nm")
        if before is None or before.mode != plan.mode:
            changes.append(f"set the bench up for mode {plan.mode}")
        for change in changes:
            self._ask(change)
        return changes

    def confirm(self, question: str) -> bool:
        """Ask the operator to switch a source without a cable; True once it is done. Raises as `prepare`."""
        return self._answer(question, f"{question} Press Enter for yes, n for no.") != "n"

    def _ask(self, change: str) -> None:
        self._answer(change, f"Please {change}, then press Enter.")

    def _answer(self, request: str, prompt: str) -> str:
        if self._simulated or self._yes:
            self._tell(f"{request} ({'simulated' if self._simulated else '--yes'})")
            return ""
        if not sys.stdin.isatty():
            raise AcquisitionError(
                f"this needs an operator: {request}. No terminal is available to ask; use --yes if it is done."
            )
        self._tell(prompt)
        while not select.select([sys.stdin], [], [], LOOK_S)[0]:
            if self._stop.requested:
                raise Stopped("stopped while waiting for the operator")
        return sys.stdin.readline().strip().lower()[:1]
