"""Console output while a capture runs: state, angles, time left; plain lines where it is no terminal."""

import time
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Column

from acquisition.screen.observer import Mosaic, Observer, StateReport
from acquisition.screen.rows import say
from processing.commands.command_line import printable
from processing.instrument.states import StateTable

#: Seconds between two lines where the output is a file or a pipe.
LINE_EVERY_S = 5.0


class ConsoleProgress(Observer):
    """A progress bar on a terminal, a line now and then elsewhere."""

    def __init__(self, console: Console) -> None:
        self._console = console
        #: On a terminal, while a capture runs.
        self.bar: Progress | None = None
        self._task: Any = None
        self._done = self._pending = 0
        # Real time, as everything that a person reads.
        self._start_s = self._line_s = time.monotonic()
        self._warned: set[str] = set()
        self._campaign_s: float | None = None
        # Captures of a campaign; 0 outside one.
        self._first = self._current = self._captures = 0

    def campaign_progress(self, number: int, total: int, name: str) -> None:
        self._current, self._captures = number, total

    def run_started(self, title: str, table: StateTable, pending: int, mosaic: Mosaic | None) -> None:
        self._done, self._pending = 0, pending
        self._start_s = time.monotonic()
        text = f"{title}: {pending} states" + (f" of {len(table)}" if pending < len(table) else "")
        self._print(f"{self._place_in_campaign()}{text}")
        if self._console.is_terminal:
            self.bar = Progress(
                # What must be seen first; the words give way where the terminal is narrow.
                *([TextColumn(f"{self._current + 1} of {self._captures}")] if self._captures else []),
                BarColumn(bar_width=16),
                MofNCompleteColumn(),
                TimeRemainingColumn(compact=True),
                TextColumn("left"),
                TextColumn("{task.description}", markup=False, table_column=Column(no_wrap=True, ratio=1)),
                expand=True,
                console=self._console,
                transient=True,
            )
            self._task = self.bar.add_task("starting", total=pending)
            self.bar.start()

    def _place_in_campaign(self) -> str:
        """Which capture of the campaign this is and how long the rest takes, as the ones of this run took."""
        if not self._captures:
            return ""
        now_s = time.monotonic()
        place = f"capture {self._current + 1} of {self._captures}"
        if self._campaign_s is None:
            self._campaign_s, self._first = now_s, self._current
            return f"{place}, "
        each_s = (now_s - self._campaign_s) / max(self._current - self._first, 1)
        return f"{place}, about {duration_text(each_s * (self._captures - self._current))} left, "

    def activity(self, text: str) -> None:
        if self.bar is not None:
            self.bar.update(self._task, description=printable(text))
        else:
            say(self._console, text)

    def state_done(self, report: StateReport) -> None:
        self._done += 1
        angles = " ".join(f"{axis} {position.deg:8.3f}" for axis, position in report.positions.items())
        text = f"state {report.state:3d} {report.role:6s} {angles}"
        if report.role != "dark":
            saturated, dim = 100 * report.saturated_fraction, 100 * report.near_black_fraction
            text += f"  saturated {saturated:.2f} %, dark {dim:.0f} %"
        if report.saturated_fraction > 0 and "saturated" not in self._warned:
            self._warned.add("saturated")
            self._print(f"warning: state {report.state}: {100 * report.saturated_fraction:.3f} % of pixels saturated")
        if self.bar is not None:
            self.bar.update(self._task, description=text, completed=self._done)
        elif time.monotonic() - self._line_s > LINE_EVERY_S:
            self._line_s = time.monotonic()
            left_s = (self._line_s - self._start_s) / self._done * (self._pending - self._done)
            say(self._console, f"{text}  {self._done}/{self._pending}, {left_s:.0f} s left")

    def warning(self, text: str) -> None:
        self._print(f"warning: {text}")

    def run_ended(self, status: str, details: dict[str, Any]) -> None:
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    def _print(self, text: str) -> None:
        say(self._console if self.bar is None else self.bar.console, text)


def duration_text(seconds: float) -> str:
    """Seconds, minutes, or hours and minutes, as a person says it."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60:02d} min"
