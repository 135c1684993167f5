"""Time budget of a capture: moving, settling, exposing, unavoidable waits, and overhead."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Literal

from drivers.clock import REAL, Clock

Entry = Literal[
    "homing",
    "approach",
    "probing",
    "moving",
    "settling",
    "setting",
    "exposure",
    "transfer",
    "writing",
    "shutter",
    "interlock",
]
#: Entries before the states, or because of an open interlock.
BESIDES = ("homing", "approach", "probing", "interlock")


class TimeLedger:
    """Adds up, in seconds of the measuring thread, what each kind of step took.

    `moving` is the time the thread waited for axes (parallel moves count once), so what overlaps a move costs
    nothing here. `overhead` is the time that no entry explains.

    Parameters
    ----------
    clock : drivers.clock.Clock
        Clock of the rig's own waits.
    """

    def __init__(self, clock: Clock = REAL) -> None:
        self._clock = clock
        self._start_s = self._clock.now_s()
        self.spent_s: dict[str, float] = {}
        self.states = 0
        # What physics asks for: per state the longest parallel move, settling, exposure and the camera's readout.
        self.unavoidable_s = 0.0
        self.readout_s = 0.0

    @contextmanager
    def time(self, entry: Entry) -> Iterator[None]:
        """Count the time inside the block."""
        start_s = self._clock.now_s()
        try:
            yield
        finally:
            self.spent_s[entry] = self.spent_s.get(entry, 0.0) + self._clock.now_s() - start_s

    def total_s(self) -> float:
        """Seconds since the ledger was opened."""
        return self._clock.now_s() - self._start_s

    def summary(self) -> dict[str, float]:
        """Seconds of each entry, `overhead`, `total`, `unavoidable`, and `excess`.

        `excess` is the time of the states over `unavoidable`, minus 1; homing, the way to the first state, probing
        for the exposure and open interlocks are no part of it. `excess_with_readout` counts the camera's own delay
        (`of_it_readout`) as avoidable too.
        """
        total = self.total_s()
        spent_s = sum(self.spent_s.values())
        summary = {f"{name}_s": round(value, 4) for name, value in sorted(self.spent_s.items())}
        summary |= {"overhead_s": round(total - spent_s, 4), "total_s": round(total, 4), "states": float(self.states)}
        if self.unavoidable_s > 0:
            summary["unavoidable_s"] = round(self.unavoidable_s, 4)
            summary["of_it_readout_s"] = round(self.readout_s, 4)
        return _with_excess(summary)


def add_summaries(summaries: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The summary of several runs that took one capture."""
    total: dict[str, float] = {}
    for summary in summaries:
        for name, value in summary.items():
            total[name] = round(total.get(name, 0.0) + value, 4)
    return _with_excess(total)


def _with_excess(summary: dict[str, float]) -> dict[str, float]:
    unavoidable_s = summary.get("unavoidable_s", 0.0)
    if unavoidable_s > 0:
        states_s = summary["total_s"] - sum(summary.get(f"{entry}_s", 0.0) for entry in BESIDES)
        summary["excess"] = round(states_s / unavoidable_s - 1, 4)
        summary["excess_with_readout"] = round(states_s / (unavoidable_s - summary["of_it_readout_s"]) - 1, 4)
    return summary
