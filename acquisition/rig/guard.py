"""The guard: a process beside `acquire` that shuts the light and stops the axes when `acquire` dies or is frozen.

`python -m acquisition.rig.guard` is started by `acquire` (acquisition/rig/guarded.py) and listens at its standard
input: first a line of JSON that says what to guard, then a short line ten times a second. The end of the input without
the word `rest` means that `acquire` was killed; silence means that it was stopped or hangs. A frozen `acquire` still
holds the ports and knows nothing of what happens to its axes: it is killed first, which loses no state that is done.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import select
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from acquisition.rig.config import RigConfig
from acquisition.rig.stop_axes import stop_axes
from drivers.errors import DeviceError
from drivers.registry import open_source
from drivers.serial_link import LineRegistry
from processing.yaml_file import parse_yaml

#: Silence after which `acquire` counts as frozen: if it was stopped, and if it could run but does not.
STOPPED_S = 1.0
SILENT_S = 10.0
#: How often it is looked for.
LOOK_S = 0.05
#: A look that came later than this was held up itself, as then was `acquire`: no more of it counts as silence.
LATE_S = 0.2
#: Tries to shut the light before somebody is called, and in all: one that dies holds its ports a moment longer, on a
#: machine with no time to spare for seconds, and a lamp that burns on is worth every further try.
CALL_S = 2.0
TRY_S = 60.0
#: How often the log says that all is well.
HEARTBEAT_S = 60.0
#: Words that `acquire` sends instead of a beat.
REST = "rest"
FAILED = "failed "


class Journal:
    """A log in JSON lines; without a path it goes to standard error."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._lock = threading.Lock()

    def note(self, event: str, **details: Any) -> None:
        """Add a line; a log that cannot be written holds up nothing."""
        when = datetime.datetime.now().astimezone().isoformat(timespec="milliseconds")
        text = json.dumps({"time": when, "event": event} | details) + "\n"
        with self._lock, contextlib.suppress(OSError):
            if self._path is None:
                sys.stderr.write(text)
            else:
                with self._path.open("a", encoding="utf-8") as file:
                    file.write(text)


class Guard:
    """Watches one `acquire` and acts in its place.

    Parameters
    ----------
    config : the rig that is open there.
    pid : of the `acquire` that is watched.
    journal : where everything is noted.
    alert : command that is run with a message as its last argument when somebody should come.
    """

    def __init__(self, config: RigConfig, pid: int, journal: Journal, alert: tuple[str, ...]) -> None:
        self.config, self.pid, self.journal, self.alert = config, pid, journal, alert
        # Nobody waits for them; they are kept because a handle that is dropped complains.
        self.alerts: list[subprocess.Popen[bytes]] = []

    def watch(self, beats: int) -> bool:
        """Listen until `acquire` ends; True if it ended in order, and False once everything was shut in its place.

        Parameters
        ----------
        beats : descriptor to read from.
        """
        silent_s, beat, rest = 0.0, "begin", b""
        noted_s = before_s = time.monotonic()
        self.journal.note("guard watches", pid=self.pid, rig=self.config.name)
        while True:
            heard = select.select([beats], [], [], LOOK_S)[0]
            now_s = time.monotonic()
            silent_s = 0.0 if heard else silent_s + min(now_s - before_s, LATE_S)
            before_s = now_s
            if heard:
                data = os.read(beats, 1 << 16)
                if not data:
                    return self._act("acquire died", beat)
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    beat = line.decode(errors="replace")
                    if beat.startswith(FAILED):
                        self._call(beat.removeprefix(FAILED))
                    elif beat == REST:
                        self.journal.note("guard rests")
                        return True
            elif silent_s > SILENT_S or (silent_s > STOPPED_S and _is_stopped(self.pid)):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(self.pid, signal.SIGKILL)
                return self._act("acquire was frozen and has been killed", beat)
            if now_s - noted_s > HEARTBEAT_S:
                noted_s = now_s
                self.journal.note("heartbeat", last=beat)

    def _act(self, why: str, beat: str) -> bool:
        self.journal.note(why, last=beat)
        with ThreadPoolExecutor(1) as beside:
            light = beside.submit(self._shut_light)
            axes = self._stop_axes()
        self._call(f"{why}. The guard: {light.result()}, {axes}. Go on with --resume, or the same campaign")
        return False

    def _shut_light(self) -> str:
        if self.config.source is None:
            return "this rig has no source to shut"
        begin_s, called = time.monotonic(), False
        while True:
            try:
                with LineRegistry() as lines:
                    open_source(self.config.source, lines).set_light(False)
                self.journal.note("light shut")
                return "light shut"
            except DeviceError as error:
                tried_s = time.monotonic() - begin_s
                if tried_s > TRY_S:
                    self.journal.note("LIGHT NOT SHUT", error=str(error))
                    return "LIGHT NOT SHUT"
                if tried_s > CALL_S and not called:
                    called = True
                    self._call(f"The light could not be shut yet: {error}. The guard tries on")
            time.sleep(LOOK_S)

    def _stop_axes(self) -> str:
        try:
            stopped = stop_axes(self.config, lambda text: self.journal.note("axis", told=text), let_go=(self.pid,))
        except DeviceError as error:
            self.journal.note("AXES NOT STOPPED", error=str(error))
            return "AXES NOT STOPPED"
        told = "axes at rest" if stopped else "AXES NOT AT REST"
        self.journal.note(told)
        return told

    def _call(self, message: str) -> None:
        if not self.alert:
            return
        try:
            self.alerts.append(
                subprocess.Popen([*self.alert, message], stdin=subprocess.DEVNULL, start_new_session=True)
            )
            self.journal.note("alert", message=message)
        except OSError as error:
            self.journal.note("ALERT FAILED", error=str(error), message=message)


def _is_stopped(pid: int) -> bool:
    """Whether a process was stopped by a signal or a tracer, and not only kept waiting by a busy machine."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "Tt"
    except OSError:
        return False


def main() -> None:
    """Guard what the first line at standard input says."""
    # Ctrl-C at the terminal is for acquire, which ends in order; the guard outlives it.
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    first = bytearray()
    while not first.endswith(b"\n"):
        byte = os.read(0, 1)
        if not byte:
            return
        first += byte
    what = json.loads(first)
    config = parse_yaml(what["rig"], RigConfig, source="rig")
    journal = Journal(Path(what["log"]) if what["log"] else None)
    sys.exit(0 if Guard(config, what["pid"], journal, config.alert).watch(0) else 1)


if __name__ == "__main__":
    main()
