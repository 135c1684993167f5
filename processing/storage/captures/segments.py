"""The segments of a capture: each run of `acquire` that took states of it, with what was true during that run.

A capture that went through in one go has one segment. Each further one began with `--resume` or with a retry of a
campaign: the light and the settings may have changed in between, so what is constant within a capture is constant
within a segment only.
"""

import json
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from processing.section import Section


class Identity(Section):
    """Configuration of a run, as digests (SHA-256) and as the devices reported it.

    `files` are the files that rig and plan name, by their key; `devices` the properties of each device that must not
    change within a capture: kind, model, serial number, firmware.
    """

    simulated: bool
    plan: str
    rig: str
    instrument: str
    software: str
    files: dict[str, str] = Field(default_factory=dict)
    devices: dict[str, dict[str, str]] = Field(default_factory=dict)


@dataclass(frozen=True)
class Segment:
    """One run that took states.

    Attributes
    ----------
    number : from 0.
    states : positions, among the states done, of those that it took.
    begun, ended : ISO 8601; `ended` is None for a run that was killed.
    by : user, machine and process.
    identity : None in a file that was imported or is older than segments.
    camera_settings, places : as read back at the start; ports and addresses of the devices.
    status : complete, aborted, failed, or "cut off" for a run that was killed.
    ledger, messages, interlocks : of this run alone.
    """

    number: int
    states: NDArray[np.int64]
    begun: str = ""
    ended: str | None = None
    by: str = ""
    identity: Identity | None = None
    camera_settings: dict[str, Any] = field(default_factory=dict)
    places: dict[str, str] = field(default_factory=dict)
    status: str = "cut off"
    ledger: dict[str, float] = field(default_factory=dict)
    messages: tuple[str, ...] = ()
    interlocks: tuple[dict[str, Any], ...] = ()


def encode_line(record: bytes) -> bytes:
    """A record, as JSON without line breaks, as a line of the journal: its CRC-32 goes before it."""
    return b"%08x %s\n" % (zlib.crc32(record), record)


def decode_lines(raw: bytes) -> tuple[list[dict[str, Any]], int]:
    """Records of a journal and the byte at which the next one goes: a line that was cut off does not count."""
    records: list[dict[str, Any]] = []
    end = 0
    while (newline := raw.find(b"\n", end)) >= 0:
        line = raw[end:newline]
        try:
            is_sound = int(line[:8], 16) == zlib.crc32(line[9:])
        except ValueError:
            is_sound = False
        if not is_sound:
            break
        records.append(json.loads(line[9:]))
        end = newline + 1
    return records, end


def segments_of(records: list[dict[str, Any]], segment_of_state: NDArray[np.integer[Any]]) -> tuple[Segment, ...]:
    """The segments in a journal; a file without a journal has one segment with every state."""
    begun = [record for record in records if record["event"] == "begin"]
    ended = {record["segment"]: record for record in records if record["event"] == "end"}
    if not begun:
        return (Segment(0, np.arange(len(segment_of_state)), status="complete"),)
    segments = []
    for number, begin in enumerate(begun):
        end = ended.get(number, {})
        segments.append(
            Segment(
                number=number,
                states=np.flatnonzero(segment_of_state == number),
                begun=begin["time"],
                ended=end.get("time"),
                by=begin["by"],
                identity=Identity.model_validate(begin["identity"]),
                camera_settings=begin["camera_settings"],
                places=begin["places"],
                status=end.get("status", "cut off"),
                ledger=end.get("ledger", {}),
                messages=tuple(end.get("messages", ())),
                interlocks=tuple(end.get("interlocks", ())),
            )
        )
    return tuple(segments)
