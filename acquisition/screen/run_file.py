"""State of a run for other programs of this machine: one small file next to its captures, while it runs.

Who looks from elsewhere sees where the run is, and may send its process what Ctrl-C sends. A thread of its own writes
the file a few times a second: a slow or full disc keeps nobody from measuring.
"""

import contextlib
import json
import os
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any, Self

from acquisition.disc import on_disc
from acquisition.errors import AcquisitionError
from acquisition.screen.observer import Mosaic, Observer, StateReport
from processing.doors import read_json
from processing.errors import ProcessError
from processing.instrument.states import StateTable
from processing.whole_file import open_plain

#: Seconds between two versions of the file.
EVERY_S = 0.3
#: Messages that are kept, and characters of each.
MESSAGES, LONGEST = 50, 300
PATTERN = ".run-*.json"
#: Ending of a version that is being written.
NEW = ".new"


class RunFile(Observer):
    """Keeps `.run-PID.json` in the folder of the captures up to date; a context manager."""

    def __init__(self, folder: Path, simulated: bool) -> None:
        self._path = folder / f".run-{os.getpid()}.json"
        self._messages: deque[str] = deque(maxlen=MESSAGES)
        self._facts: dict[str, Any] = {
            "pid": os.getpid(),
            "begun_ticks": start_ticks(os.getpid()),
            "simulated": simulated,
            "title": "",
            "activity": "starting",
            "done": 0,
            "pending": 0,
        }
        self._changed = threading.Event()
        self._ended = threading.Event()
        self._start_s = time.monotonic()
        self._writing = threading.Thread(target=self._keep, name="run file", daemon=True)

    def __enter__(self) -> Self:
        on_disc(f"look at {self._path.parent}", _remove_left, self._path.parent)
        self._writing.start()
        self._show()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._changed.set()
        self._writing.join(timeout=1)

    def campaign_progress(self, number: int, total: int, name: str) -> None:
        self._show(campaign_done=number, campaign_total=total, capture=name)

    def run_started(self, title: str, table: StateTable, pending: int, mosaic: Mosaic | None) -> None:
        self._start_s = time.monotonic()
        self._show(title=title, done=0, pending=pending, left_s=None)

    def activity(self, text: str) -> None:
        self._show(activity=text[:LONGEST])

    def state_done(self, report: StateReport) -> None:
        done, pending = self._facts["done"] + 1, self._facts["pending"]
        self._show(
            done=done,
            activity=f"state {report.state} ({report.role})",
            left_s=round((time.monotonic() - self._start_s) / done * (pending - done), 1),
            axes={name: str(position) for name, position in report.positions.items()},
            exposure_s=report.exposure_s,
            saturated=report.saturated_fraction,
        )

    def warning(self, text: str) -> None:
        self._messages.appendleft(f"{time.strftime('%H:%M:%S')} {text[:LONGEST]}")
        self._show()

    def run_ended(self, status: str, details: dict[str, Any]) -> None:
        self._show(activity=status)

    def _show(self, **changes: Any) -> None:
        # One new value, never a change of the old one: the thread reads without a lock.
        self._facts = self._facts | changes | {"messages": list(self._messages)}
        self._changed.set()

    def _keep(self) -> None:
        while not self._ended.is_set():
            self._changed.wait()
            self._changed.clear()
            with contextlib.suppress(OSError, AcquisitionError):
                on_disc(f"write {self._path}", _replace, self._path, json.dumps(self._facts))
            self._ended.wait(EVERY_S)
        with contextlib.suppress(OSError, AcquisitionError):
            on_disc(f"remove {self._path}", self._path.unlink, missing_ok=True)


def _remove_left(folder: Path) -> None:
    """Remove what runs have left that were killed, or killed while they wrote."""
    for old in folder.glob(".run-*"):
        if old.suffix in (".json", NEW) and _read(old.with_suffix(".json")) is None:
            with contextlib.suppress(OSError):
                old.unlink()


def _replace(path: Path, text: str) -> None:
    new = path.with_suffix(NEW)
    with open(open_plain(new, os.O_WRONLY), "w", encoding="utf-8") as file:
        file.truncate(0)
        file.write(text)
    os.replace(new, path)


def start_ticks(pid: int) -> int | None:
    """When a process began, in the kernel's ticks: with its number it names it for good. None if it has ended."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8")
    except OSError:
        return None
    # The second field is its name in brackets, which may hold anything.
    fields = stat.rpartition(")")[2].split()
    return None if fields[0] == "Z" else int(fields[19])


def running_in(folder: Path) -> dict[str, Any] | None:
    """The state of the program that takes captures in a folder; None if there is none."""
    return next((facts for path in sorted(folder.glob(PATTERN)) if (facts := _read(path)) is not None), None)


def _read(path: Path) -> dict[str, Any] | None:
    """A run file whose process still runs."""
    with contextlib.suppress(ProcessError):
        facts = read_json(path)
        if isinstance(facts, dict) and isinstance(pid := facts.get("pid"), int):
            ticks = start_ticks(pid)
            return facts if ticks is not None and ticks == facts.get("begun_ticks") else None
    return None
