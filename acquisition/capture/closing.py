"""The closing record of a capture, made of the end records of its segments, and the messages of a run for it."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acquisition.capture.header import now
from acquisition.capture.time_ledger import add_summaries
from acquisition.rig import alarms


@dataclass
class Messages:
    """Messages for the closing record; the first 200 are kept."""

    texts: list[str] = field(default_factory=list)
    dropped: int = 0

    def add(self, text: str) -> None:
        """Note a message with its time."""
        if len(self.texts) < 200:
            self.texts.append(f"{time.strftime('%H:%M:%S')} {text[:500]}")
        else:
            self.dropped += 1


def closing_record(records: Sequence[dict[str, Any]], last: dict[str, Any]) -> dict[str, Any]:
    """The closing record: the last segment's, with times, messages and interlocks of all of them.

    Parameters
    ----------
    records : the journal of the segments before the last one ended.
    """
    ends = [record for record in records if record["event"] == "end"] + [last]
    killed = sum(record["event"] == "begin" for record in records) - len(ends)
    closing = {key: value for key, value in last.items() if key not in ("event", "segment", "time")}
    closing["end_time"] = last["time"]
    closing["segments"] = last["segment"] + 1
    closing["segments_cut_off"] = killed
    closing["ledger"] = add_summaries([end["ledger"] for end in ends])
    closing["messages"] = [text for end in ends for text in end["messages"]]
    closing["messages_dropped"] = sum(end["messages_dropped"] for end in ends)
    closing["evidence"] = [finding for end in ends for finding in end.get("evidence", [])]
    closing["interlocks"] = [event for end in ends for event in end["interlocks"]]
    return closing


def keep_end(path: Path, closing: dict[str, Any]) -> str:
    """Write the closing record into memory, where the disc does not take it; returns a sentence that says where."""
    return alarms.keep("record of the end", f"end-{path.name}.json", json.dumps(closing, indent=1, default=str))


def closing_of_killed(records: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The closing record of a capture with all its states, whose last run was killed before it wrote one."""
    last = {
        "event": "end",
        "segment": sum(record["event"] == "begin" for record in records) - 1,
        "time": now(),
        "status": "complete",
        "ledger": {},
        "messages": ["all states were complete, but the run was cut off before its end; sealed afterwards"],
        "messages_dropped": 0,
        "interlocks": [],
    }
    if records and records[-1]["event"] == "end":
        last = dict(records[-1], status="complete")
        records = records[:-1]
    return closing_record(records, last)
