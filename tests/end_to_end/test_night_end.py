"""What a night leaves: a summary, a word to somebody, a folder that can be processed although it was stopped."""

import http.server
import io
import json
import re
import sys
import threading

import numpy as np
import pytest
from rich.console import Console

from acquisition.campaign.summary import summary_lines
from acquisition.errors import AcquisitionError
from acquisition.screen.notify import NotifyConfig, notifying
from acquisition.screen.observer import StateReport
from acquisition.screen.progress import ConsoleProgress, duration_text
from acquisition.screen.rows import print_rows
from drivers.motion import Position
from processing.campaign.captures import find_captures
from processing.errors import ProcessError
from processing.instrument.states import rotating_retarders

#: Writes its last argument and what it is told on standard input into the file named first.
LISTENER = "import sys; open(sys.argv[1], 'a').write(sys.argv[2] + '|' + sys.stdin.read() + '\\n')"


@pytest.fixture
def hook(tmp_path):
    """A command that keeps what it is told, and what it has kept."""
    path = tmp_path / "heard"
    command = (sys.executable, "-c", LISTENER, str(path))
    return command, lambda: path.read_text().splitlines() if path.exists() else []


def test_end_interlock_and_failure_are_told_to_a_command(hook, tmp_path):
    command, messages = hook
    with notifying(NotifyConfig(command=command), tmp_path / "c.h5", True) as notifier:
        notifier.warning("a frame was lost")
        notifier.warning("interlock: the door is open; the state is discarded")
        notifier.settle()
        notifier.tell("end", "44 of 44 states, complete")
    first, last = messages()
    words, message = last.split("|")
    assert words == "SIMULATED end: 44 of 44 states, complete"
    assert json.loads(message) | {"event": "end", "simulated": True, "what": str(tmp_path / "c.h5")} == json.loads(
        message
    )
    assert first.startswith("SIMULATED interlock: interlock: the door is open")
    with pytest.raises(AcquisitionError), notifying(NotifyConfig(command=command), tmp_path, False):
        raise AcquisitionError("psg stalled")
    assert messages()[2].startswith("failure: psg stalled|")


def test_only_what_was_asked_for_is_told_and_a_command_that_fails_harms_nothing(hook, tmp_path):
    command, messages = hook
    with notifying(NotifyConfig(command=command, on=("failure",)), tmp_path, False) as notifier:
        notifier.tell("end", "complete")
    with notifying(
        NotifyConfig(command=("/nowhere/at/all",), webhook="http://127.0.0.1:1/"), tmp_path, False
    ) as notifier:
        notifier.tell("end", "complete")
    with notifying(None, tmp_path, False) as notifier:
        notifier.tell("end", "complete")
    assert messages() == []


def test_a_webhook_gets_the_same_as_json(tmp_path):
    messages = []

    class Hook(http.server.BaseHTTPRequestHandler):
        def do_POST(self):
            messages.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, *_):
            pass

    with http.server.HTTPServer(("127.0.0.1", 0), Hook) as server:
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        with notifying(NotifyConfig(webhook=f"http://127.0.0.1:{server.server_port}/x"), tmp_path, False) as notifier:
            notifier.tell("end", "done", summary=["72 of 72"])
        thread.join()
    assert [message["event"] for message in messages] == ["end"]
    assert messages[0]["summary"] == ["72 of 72"]


def test_the_summary_names_what_is_missing(tmp_path):
    index = {
        "a.h5": {"status": "complete", "saturated_fraction": 0.2},
        "b.h5": {"status": "failed", "error": "psg\nstalled", "saturated_fraction": None},
    }
    (tmp_path / "log.jsonl").write_text(
        '{"time": "T1", "event": "campaign started"}\n{"time": "T2", "event": "capture failed"}\n{"cut off'
    )
    lines = summary_lines(tmp_path, ["a.h5", "b.h5", "c.h5"], index)
    assert lines[0] == "1 of 3 captures complete (1 failed, 1 not begun)"
    assert "failed: b.h5 (psg stalled)" in lines
    assert "saturated: a.h5" in lines
    assert lines[-2:] == ["first started T1, last word T2", "1 x capture failed"]


def test_a_stopped_campaign_is_processed_without_what_is_not_complete(synthetic_capture, tmp_path):
    frames = np.full((4, 1, 6, 8), 900, np.uint16)
    angles = {"psg": np.arange(4.0), "psa": np.arange(4.0)}
    complete = synthetic_capture(frames, angles, name="whole.h5", omega_deg=35.0)
    synthetic_capture(frames, angles, name="half.h5", omega_deg=40.0, done=np.array([1, 1, 0, 0]))
    synthetic_capture(frames, angles, name="cut.h5.partial", omega_deg=45.0, done=0)
    (tmp_path / "index.json").write_text(
        json.dumps({"whole.h5": {"status": "complete"}, "gone.h5": {"status": "failed"}})
    )
    captures, simulated, left_out, damaged = find_captures(tmp_path)
    assert [path for path, *_ in captures] == [complete]
    assert simulated
    assert not damaged
    assert any("half.h5: 2 of 4 states" in line for line in left_out)
    assert any("cut.h5.partial: a capture that is not finished" in line for line in left_out)
    assert any("gone.h5: failed" in line for line in left_out)
    complete.unlink()
    with pytest.raises(ProcessError, match="no complete capture"):
        find_captures(tmp_path)


def _shown(width: int, captures: int = 0) -> str:
    """What a terminal of this width shows in the middle of a capture."""
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=width, color_system=None)
    progress = ConsoleProgress(console)
    if captures:
        progress.campaign_progress(2, captures, "003_sphere.h5")
    progress.run_started("a title", rotating_retarders(1.0, 40), 40, None)
    positions = {name: Position(123.456, 0.0) for name in ("arm", "psg", "psa")}
    pixels = np.zeros((2, 2), np.uint16)
    for state in range(20):
        progress.state_done(StateReport(state, "sample", positions, 0.02, 0.0, 0.05, 1.0, pixels))
    progress.bar.refresh()
    progress.run_ended("complete", {})
    return out.getvalue()


@pytest.mark.parametrize("captures", [0, 72])
def test_bar_count_and_time_left_survive_at_80_columns(captures):
    line = next(line for line in reversed(_shown(80, captures).splitlines()) if "20/40" in line)
    assert "━" in line
    assert "left" in line
    assert ("3 of 72" in line) == bool(captures)


def test_the_console_says_how_far_the_campaign_is():
    assert "capture 3 of 72, a title: 40 states" in _shown(80, 72)
    assert [duration_text(s) for s in (42, 360, 7380)] == ["42 s", "6 min", "2 h 03 min"]


def test_piped_rows_are_not_padded_and_no_color_is_honoured(monkeypatch):
    out = io.StringIO()
    print_rows([("ok", "disc", "enough " * 30), ("", "rig", "x")], Console(file=out))
    assert out.getvalue().splitlines()[1] == "rig  x"
    assert len(out.getvalue().splitlines()) == 2
    monkeypatch.setenv("NO_COLOR", "1")
    coloured = io.StringIO()
    print_rows([("BAD", "disc", "full")], Console(file=coloured, force_terminal=True))
    assert "\x1b[31" not in coloured.getvalue()
    assert "\x1b[1;31" not in coloured.getvalue()


def test_no_part_of_a_long_path_is_cut_off_a_narrow_terminal():
    out, path = io.StringIO(), "/home/lab/rigs/../scenes/" + "a_long_name" * 6 + ".yaml"
    print_rows([("BAD", "scene mirror", path)], Console(file=out, force_terminal=True, width=60, no_color=True))
    assert path in re.sub(r"\x1b\[[0-9;]*m|\s|BAD|scene mirror", "", out.getvalue())
