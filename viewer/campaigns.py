"""A campaign as people see it: a grid of its captures, when each was taken, and how long the rest will take."""

import contextlib
import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from acquisition.campaign.identity import read_identity
from acquisition.campaign.log import LOG, read_index
from acquisition.capture.partial_file import PARTIAL
from processing.doors import MOST_JSON_BYTES, read_text
from viewer.library import SATURATED, Entry, Library, NotHere

#: States of a cell with their meaning, in the order of the legend.
STATUS = {
    "done": "complete",
    "flagged": "complete, with something to look at",
    "partial": "begun, not complete",
    "running": "being taken",
    "failed": "given up after an error",
    "missing": "not begun",
}


@dataclass(frozen=True)
class Cell:
    """One capture of a campaign.

    Attributes
    ----------
    status : a key of `STATUS`.
    file : name of its file in the library; None where there is none yet.
    remark : in words.
    """

    number: int
    name: str
    sample: str
    mode: str
    wavelength_nm: float
    omega_deg: float
    reference: bool
    status: str
    file: str | None = None
    remark: str = ""


@dataclass(frozen=True)
class CampaignBlock:
    """Captures of one mode at one wavelength: a row for each sample, a column for each angle; references in a row."""

    mode: str
    wavelength_nm: float
    angles_deg: tuple[float, ...]
    rows: tuple[tuple[str, tuple[Cell | None, ...]], ...]
    references: tuple[Cell, ...]


@dataclass(frozen=True)
class Bar:
    """One run of a capture on the timeline; times are ISO 8601, `end` None while it runs."""

    name: str
    start: str
    end: str | None
    status: str


@dataclass(frozen=True)
class CampaignView:
    """Everything that a page shows of a campaign."""

    name: str
    simulated: bool
    rig_file: str
    cells: tuple[Cell, ...]
    bars: tuple[Bar, ...]
    events: tuple[tuple[str, str], ...]

    @property
    def counts(self) -> dict[str, int]:
        """Captures of each status, those that there are."""
        return {s: n for s in STATUS if (n := sum(cell.status == s for cell in self.cells))}

    @property
    def complete(self) -> int:
        """Captures that are complete."""
        return sum(cell.status in ("done", "flagged") for cell in self.cells)

    def blocks(self) -> list[CampaignBlock]:
        """The grid, in the order in which it is taken."""
        keys = dict.fromkeys((cell.mode, cell.wavelength_nm) for cell in self.cells)
        return [self._block(*key) for key in keys]

    def _block(self, mode: str, wavelength_nm: float) -> CampaignBlock:
        cells = [c for c in self.cells if (c.mode, c.wavelength_nm) == (mode, wavelength_nm)]
        plain = [c for c in cells if not c.reference]
        angles = tuple(sorted({c.omega_deg for c in plain}))
        cell_of = {(c.sample, c.omega_deg): c for c in plain}
        samples = dict.fromkeys(c.sample for c in plain)
        rows = tuple((sample, tuple(cell_of.get((sample, angle)) for angle in angles)) for sample in samples)
        return CampaignBlock(mode, wavelength_nm, angles, rows, tuple(c for c in cells if c.reference))


def read_campaign(folder: Path, library: Library, running: str | None = None) -> CampaignView | None:
    """The campaign in a folder; None where none was begun.

    Parameters
    ----------
    running : capture that is being taken now, as the program that takes it says.
    """
    identity = read_identity(folder)
    if identity is None:
        return None
    index, plans = read_index(folder), identity.get("plan", {})
    entries = {name: _entry(folder / name, library) for name in plans}
    cells = {
        name: _cell(number, name, plan, index.get(name, {}), entry=entries[name], running=name == running)
        for number, (name, plan) in enumerate(plans.items(), 1)
    }
    events = list(_events(folder / LOG))
    bars = (_match_grid(bar, cells.get(bar.name), entries.get(bar.name)) for bar in _bars(events))
    return CampaignView(
        name=library.name(folder),
        simulated=bool(identity.get("simulated")),
        rig_file=str(identity.get("rig_file", "")),
        cells=tuple(cells.values()),
        bars=tuple(bars),
        events=tuple((str(e.get("time", "")), _event_text(e)) for e in reversed(events[-100:])),
    )


def _entry(path: Path, library: Library) -> Entry | None:
    # A capture may get its final name between the look at the one and at the other.
    for candidate in (path, path.with_name(path.name + PARTIAL), path):
        if library.holds(candidate):
            with contextlib.suppress(NotHere):
                return library.entry(library.name(candidate))
    return None


def _cell(
    number: int, name: str, plan: dict[str, Any], index: dict[str, Any], *, entry: Entry | None, running: bool
) -> Cell:
    status, remark = "missing", ""
    if running:
        status = "running"
    elif entry is not None and entry.status == "complete":
        flagged = bool(entry.flags) or float(index.get("saturated_fraction") or 0.0) > SATURATED
        status, remark = ("flagged" if flagged else "done"), "; ".join(entry.flags)
    elif index.get("status") == "failed":
        status, remark = "failed", str(index.get("error") or "")
    elif entry is not None:
        status = "failed" if entry.kind == "unreadable" else "partial"
        remark = "; ".join(entry.flags)
    if entry is not None and entry.states is not None:
        remark = f"{entry.states[0]} of {entry.states[1]} states" + (f"; {remark}" if remark else "")
    sample = plan.get("sample", {})
    return Cell(
        number=number,
        name=name,
        sample=str(sample.get("name") or sample.get("kind", "")),
        mode=str(plan.get("mode", "")),
        wavelength_nm=float(plan.get("wavelength_nm", 0.0)),
        omega_deg=float(plan.get("omega_deg") or 0.0),
        reference=bool(index.get("reference")) or plan.get("role") == "flat" or sample.get("kind") == "air",
        status=status,
        file=None if entry is None else entry.name,
        remark=remark,
    )


def _events(log: Path) -> Iterator[dict[str, Any]]:
    if not log.exists():
        return
    for line in read_text(log, most_bytes=4 * MOST_JSON_BYTES).splitlines():
        try:
            event = json.loads(line)
        except ValueError:
            # Cut off where the disc was full.
            continue
        if isinstance(event, dict):
            yield event


def _bars(events: list[dict[str, Any]]) -> Iterator[Bar]:
    open_bar: tuple[str, str] | None = None
    for event in events:
        kind, when = event.get("event"), str(event.get("time", ""))
        if kind == "capture started":
            open_bar = (str(event.get("capture")), when)
        elif open_bar is not None and kind in ("capture ended", "capture failed", "campaign stopped at once"):
            status = {"capture ended": str(event.get("status")), "capture failed": "failed"}.get(str(kind), "partial")
            yield Bar(*open_bar, when, {"complete": "done", "aborted": "partial"}.get(status, status))
            open_bar = None
        elif open_bar is not None and kind == "campaign started":
            # A killed run has no entry of its end.
            yield Bar(*open_bar, when, "failed")
            open_bar = None
    if open_bar is not None:
        yield Bar(*open_bar, None, "running")


def _match_grid(bar: Bar, cell: Cell | None, entry: Entry | None) -> Bar:
    """The bar with facts that are not in the log: a flag of the capture, or the time at which its run was killed."""
    if cell is not None and (bar.status, cell.status) == ("done", "flagged"):
        return replace(bar, status="flagged")
    if bar.end is None and (cell is None or cell.status != "running"):
        # The last state that came into its file is the last that is known of it.
        end = bar.start if entry is None else datetime.fromtimestamp(entry.changed_s, UTC).isoformat()
        return replace(bar, end=max(end, bar.start), status="partial")
    return bar


def _event_text(event: dict[str, Any]) -> str:
    parts = [str(event.get("event"))]
    parts += [str(event[key]) for key in ("capture", "at", "error", "why") if event.get(key)]
    if event.get("status"):
        parts.append(f"{event['status']}, {event.get('states')} states")
    return ": ".join(parts[:2]) + ("" if len(parts) < 3 else f" ({'; '.join(parts[2:])})")


def seconds_left(view: CampaignView, run: dict[str, Any]) -> float | None:
    """How long the rest of a running campaign will take; None while nothing tells.

    The captures that are missing count as the median of those that were taken, else as the one that is being taken.

    Parameters
    ----------
    run : state of the run (`acquisition.screen.run_file`).
    """
    left_s, pending, done = run.get("left_s"), run.get("pending") or 0, run.get("done") or 0
    durations_s = sorted(
        (datetime.fromisoformat(bar.end) - datetime.fromisoformat(bar.start)).total_seconds()
        for bar in view.bars
        if bar.end is not None and bar.status in ("done", "flagged")
    )
    missing = sum(cell.status in ("missing", "partial", "failed") for cell in view.cells)
    if durations_s:
        each_s = durations_s[len(durations_s) // 2]
    elif left_s is not None and pending > done:
        each_s = left_s * pending / (pending - done)
    else:
        return None
    return each_s * missing + (left_s or 0.0)
