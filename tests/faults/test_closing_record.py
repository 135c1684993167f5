"""A capture is sealed however much its closing record has to tell, and the record says what was cut."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquisition.capture.runner import Messages
from acquisition.capture.writer import CaptureWriter
from processing.instrument.states import StateTable
from processing.reports.report import write_report
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import CaptureHeader

HEADER = CaptureHeader(title="long", simulated=True, mode="drr", wavelength_nm=662)


def sealed(folder: Path, closing: dict[str, Any]) -> dict[str, Any]:
    """The closing record that a reader finds in a capture sealed with this one."""
    table = StateTable(
        angles_deg={"psg": np.zeros(1)}, role=("sample",), exposure_s=np.full(1, 0.01), repeats=np.ones(1, dtype=int)
    )
    writer = CaptureWriter.create(folder / "c.h5", HEADER, table, (4, 4), start_time="2026-01-01T00:00:00")
    path = writer.seal("complete", closing)
    with Capture(path) as capture:
        assert capture.status == "complete"
        return capture.closing


def texts(character: str) -> list[str]:
    messages = Messages()
    for _ in range(300):
        messages.add(character * 600)
    assert len(messages.texts) == 200
    return messages.texts


def test_a_record_that_fits_is_kept_whole(tmp_path):
    closing = {"end_time": "now", "messages": texts("a"), "ledger": {"moving_s": 1.5}}
    assert sealed(tmp_path, closing) == closing


@pytest.mark.parametrize("character", ["ü", "光", "🔦", "\udcff"], ids=["2 bytes", "3 bytes", "4 bytes", "surrogate"])
def test_messages_of_any_alphabet(tmp_path, character):
    messages = texts(character)
    record = sealed(tmp_path, {"end_time": "now", "messages": messages, "ledger": {"moving_s": 1.5}})
    stored, left_out = record["messages"], record.get("left_out", {}).get("messages", 0)
    assert stored == messages[: len(stored)]
    assert len(stored) + left_out == 200
    assert len(stored) > 60
    assert (record["end_time"], record["ledger"]) == ("now", {"moving_s": 1.5})


def test_thousands_of_interlock_events_are_cut_and_told(tmp_path):
    events = [{"state": float(k), "why": "the light has drifted by +3.00 % since the pose before"} for k in range(4000)]
    record = sealed(tmp_path, {"end_time": "now", "interlocks": events, "messages": ["one"]})
    stored = record["interlocks"]
    assert 2000 < len(stored) < 4000
    assert stored == events[: len(stored)]
    assert record["left_out"] == {"interlocks": 4000 - len(stored)}
    assert record["messages"] == ["one"]
    page = write_report([tmp_path / "c.h5"], tmp_path / "r.html", "t").read_text()
    assert f"left out: {4000 - len(stored)} of interlocks" in page


def test_one_endless_text_or_value_does_not_stop_the_seal(tmp_path):
    record = sealed(tmp_path, {"failure": "x" * 10**6, "stream": {str(k): k for k in range(10**5)}, "status": "failed"})
    assert record["failure"].startswith("xxx")
    assert record["left_out"]["failure"] == 10**6 - len(record["failure"])
    assert "stream" not in record
    assert record["status"] == "failed"
