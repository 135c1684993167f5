"""Summary of a campaign in a few lines, for the folder, the console and the notification."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from acquisition.campaign.log import LOG
from processing.doors import read_text
from processing.errors import ProcessError

SUMMARY = "summary.txt"
#: Captures of one kind that are named; the index has them all.
NAMED = 10
#: Part of the pixels of a state at full scale that is worth a word.
SATURATED = 0.001


def summary_lines(folder: Path, names: Sequence[str], index: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Status of the captures, first and last event, and problems to look at.

    Parameters
    ----------
    names : of all captures of the campaign, in order.
    index : entry of each capture that has one.
    """
    status = {name: str(index.get(name, {}).get("status", "not begun")) for name in names}
    counts = Counter(status.values())
    lines = [f"{counts['complete']} of {len(names)} captures complete" + _breakdown(counts)]
    for word in sorted(set(status.values()) - {"complete", "not begun"}):
        lines += _list_captures(word, [name for name in names if status[name] == word], index)
    bright = [name for name in names if (index.get(name, {}).get("saturated_fraction") or 0) > SATURATED]
    lines += _list_captures("saturated", bright, {})
    events = _events(folder)
    if events:
        lines.append(f"first started {events[0]['time']}, last word {events[-1]['time']}")
    kinds = Counter(str(event.get("event")) for event in events)
    incidents = [f"{kinds[kind]} x {kind}" for kind in ("capture failed", "waiting", "campaign stopped") if kinds[kind]]
    if incidents:
        lines.append(", ".join(incidents))
    return lines


def _breakdown(counts: Counter[str]) -> str:
    tallies = [f"{count} {word}" for word, count in sorted(counts.items()) if word != "complete"]
    return f" ({', '.join(tallies)})" if tallies else ""


def _list_captures(word: str, names: Sequence[str], index: Mapping[str, Mapping[str, Any]]) -> list[str]:
    lines = [f"{word}: {name}" + _error_text(index.get(name, {})) for name in names[:NAMED]]
    return lines + ([f"{word}: and {len(names) - NAMED} more"] if len(names) > NAMED else [])


def _error_text(entry: Mapping[str, Any]) -> str:
    error = entry.get("error")
    return f" ({' '.join(str(error).split())})" if error else ""


def _events(folder: Path) -> list[dict[str, Any]]:
    """Lines of the log that can be read."""
    events = []
    try:
        for line in read_text(folder / LOG, ProcessError).splitlines():
            event = json.loads(line)
            if isinstance(event, dict) and "time" in event:
                events.append(event)
    except (ProcessError, ValueError):
        # A line that was cut off by a full disc: the lines before it are reported.
        pass
    return events
