"""The guard: a process that shuts the light and stops the axes when `acquire` dies, freezes or fails to do so.

`acquire` starts ``python -m acquisition.rig.guard`` (acquisition/rig/guarded.py) with one end of a pair of sockets. It
hands over the descriptors of the open ports first: the guard writes to a port although the dying process still holds
it. Then lines of JSON go both ways, among them a beat ten times a second that the guard sends back.

The guard acts in a fixed order: light, axes, words. It opens no file on the disc of the captures: its journal goes
through a pipe to a process of its own, which may hang.
"""

import contextlib
import datetime
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from acquisition.rig import alarms
from acquisition.rig.config import RigConfig
from acquisition.rig.stop_axes import stop_axes
from drivers.errors import DeviceError
from drivers.log_process import LogProcess
from drivers.registry import open_source
from drivers.serial_link import LineRegistry
from drivers.serial_ports import HELD
from drivers.source import LightSource
from processing.yaml_file import parse_yaml

#: Silence of `acquire` after which the guard shuts the light, and after which it takes over and kills `acquire`.
#: A process that was stopped says nothing for certain; one that could run may only be kept waiting.
STOPPED_SHUT_S, STOPPED_KILL_S = 0.3, 1.0
SILENT_SHUT_S, SILENT_KILL_S = 1.2, 10.0
#: How often the guard looks.
LOOK_S = 0.05
#: A look that comes later than this was held up itself, as `acquire` probably was: no more of it counts as silence.
LATE_S = 0.2
#: Tries to shut the light before the alarm, and in quick succession; further tries follow at the alarm's pace.
CALL_S = 2.0
TRY_S = 60.0
#: Pause before axes that did not obey are sent another stop.
AGAIN_S = 1.0
#: How often the journal says that all is well.
HEARTBEAT_S = 60.0
#: An alarm that could not be written down ends after this time.
LONGEST_S = 86_400.0
#: Most ports that `acquire` hands over.
MOST_PORTS = 64
#: Report of axes that obey.
AT_REST = "axes at rest"


class Journal:
    """The journal of the guard: lines of JSON that another process appends to its file, if it has one."""

    def __init__(self, path: Path | None) -> None:
        self._log = LogProcess(path)
        self.flush = self._log.flush

    def note(self, event: str, **details: Any) -> None:
        """Add a line; a log that cannot be written holds up nothing."""
        when = datetime.datetime.now().astimezone().isoformat(timespec="milliseconds")
        self._log.add(json.dumps({"time": when, "event": event} | details) + "\n")

    def close(self) -> None:
        """Write the pending notes, as far as the disc takes them."""
        self._log.close()


class Guard:
    """Watches one `acquire` and makes the rig safe if it fails.

    Parameters
    ----------
    config : the rig that is open there; its ports are addresses of descriptors where they were handed over.
    pid : of the `acquire` that is watched.
    journal : where everything is noted.
    file_rig : the same rig with the ports as the rig file has them, for tries after `acquire` has ended.
    """

    def __init__(self, config: RigConfig, pid: int, journal: Journal, file_rig: RigConfig | None = None) -> None:
        self.config, self.pid, self.journal = config, pid, journal
        self.file_rig = file_rig or config
        # They are not waited for; the handles are stored because Python warns about a dropped one.
        self.alerts: list[subprocess.Popen[bytes]] = []
        self._cutoff_lines = LineRegistry()
        self._cutoff: LightSource | None = None
        self._light_problem = self._axes_problem = ""
        self._light_lock = threading.Lock()
        self._has_shut = False

    def open_cutoff(self) -> None:
        """Let light pass the rig's second shutter or relay, if it has one. Raises DeviceError."""
        if self.config.cutoff is not None:
            self._cutoff = open_source(self.config.cutoff, self._cutoff_lines)
            self._cutoff.set_light(True)

    def watch(self, line: socket.socket) -> bool:
        """Listen until `acquire` ends; True if it ended in order, and False once everything was shut in its place."""
        silent_s, beat, tail = 0.0, 0, b""
        noted_s = before_s = time.monotonic()
        self.journal.note("guard watches", pid=self.pid, rig=self.config.name)
        self._say(line, watching=True)
        while True:
            readable = select.select([line], [], [], LOOK_S)[0]
            now_s = time.monotonic()
            silent_s = 0.0 if readable else silent_s + min(now_s - before_s, LATE_S)
            before_s = now_s
            if readable:
                data = _receive(line)
                if not data:
                    return self._act("acquire died", beat)
                self._has_shut = False
                *lines, tail = (tail + data).split(b"\n")
                for text in lines:
                    message = json.loads(text)
                    if "beat" in message:
                        beat = message["beat"]
                        self._say(line, beat=beat)
                    elif "failed" in message:
                        self.call(message["failed"])
                    elif "take_over" in message:
                        return self._act(message["take_over"], beat)
                    else:
                        self._rest()
                        return True
            elif silent_s > STOPPED_SHUT_S and self._is_lost(line, silent_s):
                return self._act("acquire was frozen and has been killed", beat)
            self._feed()
            if now_s - noted_s > HEARTBEAT_S:
                noted_s = now_s
                self.journal.note("heartbeat", last=beat)
            self.journal.flush()

    def _is_lost(self, line: socket.socket, silent_s: float) -> bool:
        """Shut the light of an `acquire` that is silent; True once it has been killed for that."""
        is_frozen = is_stopped(self.pid)
        if silent_s > (STOPPED_KILL_S if is_frozen else SILENT_KILL_S):
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGKILL)
            return True
        if not self._has_shut and silent_s > (STOPPED_SHUT_S if is_frozen else SILENT_SHUT_S):
            # It may come back: only the light does not wait for that.
            self._has_shut = self.try_light() is None
            if self._has_shut:
                self.journal.note("light shut", why="acquire is silent")
                self._say(line, shut="the guard heard nothing from acquire")
        return False

    def _say(self, line: socket.socket, **message: Any) -> None:
        with contextlib.suppress(OSError):
            line.send(json.dumps(message).encode() + b"\n", socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)

    def _feed(self) -> None:
        if self._cutoff is not None:
            with contextlib.suppress(DeviceError):
                self._cutoff.feed()

    def _rest(self) -> None:
        if self._cutoff is not None:
            with contextlib.suppress(DeviceError):
                self._cutoff.set_light(False)
        self.journal.note("guard rests")

    def _act(self, why: str, beat: int) -> bool:
        with ThreadPoolExecutor(2) as threads:
            light = threads.submit(self._shut_light)
            axes = threads.submit(self._stop_axes)
            self.journal.note(why, last=beat)
            wait([light], CALL_S)
            alarm = None
            while not (light.done() and axes.done()):
                problem = self._axes_problem if light.done() else f"THE LIGHT IS NOT SHUT: {self._light_problem}"
                if alarm is None and problem:
                    alarm = GuardAlarm(self, f"{why}. {problem}. The guard tries again")
                if alarm is not None:
                    alarm.repeat()
                self.journal.flush()
                time.sleep(LOOK_S)
        outcome = "light shut" if light.result() is None else f"LIGHT NOT SHUT: {light.result()}"
        if self.config.source is None:
            outcome = "this rig has no source to shut"
        text = f"{why}. The guard: {outcome}, {axes.result()}. Continue with --resume, or the same campaign"
        if alarm is None and light.result() is None and axes.result() == AT_REST:
            self.call(text)
            return False
        if alarm is not None and alarm.is_acknowledged():
            self.call(text)
            self.journal.note("alarm acknowledged")
            return False
        alarm = GuardAlarm(self, text)
        is_dark = light.result() is None
        while not alarm.is_acknowledged():
            # A lamp that burns on is worth every further try.
            if alarm.repeat() and not is_dark and self.try_light() is None:
                is_dark = True
                self.journal.note("light shut", why="tried again with the alarm")
                alarm = GuardAlarm(self, f"{text}. The light has been shut since")
            self.journal.flush()
            time.sleep(LOOK_S)
        self.journal.note("alarm acknowledged")
        return False

    # --- light -------------------------------------------------------------------------------------------

    def try_light(self) -> str | None:
        """Shut the light once; None, or why it is not shut."""
        problems = []
        with self._light_lock:
            if self._cutoff is not None:
                try:
                    self._cutoff.set_light(False)
                except Exception as error:  # noqa: BLE001 - the source comes next, whatever this was
                    problems.append(str(error))
            # The port that was handed over, then the port by its name: one of the two may be gone.
            for config in (self.config, self.file_rig) if self.file_rig is not self.config else (self.config,):
                if config.source is None:
                    break
                try:
                    with LineRegistry() as lines:
                        open_source(config.source, lines).set_light(False)
                    return None
                except Exception as error:  # noqa: BLE001 - whatever it was, the light is tried again
                    problems.append(str(error))
        self._light_problem = "; ".join(problems)
        return self._light_problem or None

    def _shut_light(self) -> str | None:
        """Try for TRY_S; None once the light is shut, or what came back last."""
        begin_s = time.monotonic()
        while (problem := self.try_light()) is not None:
            if time.monotonic() - begin_s > TRY_S:
                self.journal.note("LIGHT NOT SHUT", error=problem)
                return problem
            time.sleep(LOOK_S)
        self.journal.note("light shut")
        return None

    # --- axes --------------------------------------------------------------------------------------------

    def _stop_axes(self) -> str:
        """Stop every axis, again and again for TRY_S where one does not obey; what became of it."""
        begin_s = time.monotonic()
        while True:
            try:
                if stop_axes(self.config, lambda text: self.journal.note("axis", told=text), let_go=(self.pid,)):
                    self.journal.note(AT_REST)
                    return AT_REST
                outcome = "AXES NOT AT REST"
            except Exception as error:  # noqa: BLE001 - whatever it is, the light and the alarm do not wait for it
                outcome = f"AXES NOT STOPPED: {error}"
            self.journal.note(outcome)
            self._axes_problem = outcome
            if time.monotonic() - begin_s > TRY_S:
                return outcome
            time.sleep(AGAIN_S)

    # --- words -------------------------------------------------------------------------------------------

    def call(self, message: str) -> None:
        """Run the rig's alert command, once."""
        if not self.config.alert:
            return
        try:
            self.alerts.append(
                subprocess.Popen([*self.config.alert, message], stdin=subprocess.DEVNULL, start_new_session=True)
            )
            self.journal.note("alert", message=message)
        except OSError as error:
            self.journal.note("ALERT FAILED", error=str(error), message=message)


class GuardAlarm:
    """An alarm at the console and by the rig's command, repeated until it is acknowledged."""

    def __init__(self, guard: Guard, text: str) -> None:
        self._guard = guard
        self._text = f"{text}. Acknowledge with: {alarms.ACKNOWLEDGE}"
        self._path: Path | None = None
        try:
            self._path = alarms.give_alarm(guard.config.name, text)
        except OSError as error:
            guard.journal.note("ALARM NOT WRITTEN DOWN", error=str(error))
        self._next_s = self._begin_s = time.monotonic()

    def repeat(self) -> bool:
        """Give the alarm if it is due; True if it was."""
        if time.monotonic() < self._next_s or self.is_acknowledged():
            return False
        self._next_s = time.monotonic() + self._guard.config.alert_every_s
        self._guard.call(self._text)
        _print(f"ALARM: {self._text}")
        return True

    def is_acknowledged(self) -> bool:
        """Whether its file is gone; what could not be written down counts as acknowledged after a day."""
        if self._path is None:
            return time.monotonic() - self._begin_s > LONGEST_S
        return not self._path.exists()


def _print(text: str) -> None:
    """A line at the console, in a thread: a terminal that is held takes nothing."""

    def write() -> None:
        with contextlib.suppress(OSError):
            os.write(2, f"\n{text}\n".encode())

    threading.Thread(target=write, daemon=True).start()


def _receive(line: socket.socket) -> bytes:
    try:
        return line.recv(1 << 16)
    except OSError:
        return b""


def is_stopped(pid: int) -> bool:
    """Whether a process was stopped or killed, and is not only kept waiting by a busy machine.

    A killed one keeps its ports and its line, as a zombie, while one of its threads waits for a disc in the kernel.
    """
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "TtZX"
    except OSError:
        return False


def with_held_ports(config: RigConfig, held: dict[str, int]) -> RigConfig:
    """The rig with the address of a descriptor in place of each port that was handed over.

    Parameters
    ----------
    held : real path of a device file to the descriptor here.
    """

    def at(entry: Any) -> Any:
        if entry is None:
            return None
        changes: dict[str, Any] = {}
        port = getattr(entry, "port", None)
        if port is not None and os.path.realpath(port) in held:
            changes["port"] = f"{HELD}{held[os.path.realpath(port)]}{port}"
        # A filter wheel's shutter has a port of its own.
        if getattr(entry, "shutter", None) is not None:
            changes["shutter"] = at(entry.shutter)
        return entry.model_copy(update=changes)

    axes = {name: at(entry) for name, entry in config.axes.items()}
    return config.model_copy(update={"axes": axes, "source": at(config.source)})


def main() -> None:
    """Guard the rig that the first line of the socket describes."""
    # Ctrl-C at the terminal is for acquire, which ends in order; the guard outlives it.
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    line = socket.socket(fileno=int(sys.argv[1]))
    _, descriptors, _, _ = socket.recv_fds(line, 1, MOST_PORTS)
    first = bytearray()
    while not first.endswith(b"\n"):
        byte = line.recv(1)
        if not byte:
            return
        first += byte
    hello = json.loads(first)
    config = parse_yaml(hello["rig"], RigConfig, source="rig")
    journal = Journal(Path(hello["log"]) if hello["log"] else None)
    if hello["before"]:
        journal.note("guard restarted", before=hello["before"])
    port_descriptors = dict(zip(hello["ports"], descriptors, strict=False))
    guard = Guard(with_held_ports(config, port_descriptors), hello["pid"], journal, config)
    guard.open_cutoff()
    in_order = guard.watch(line)
    # The next program may want the ports while a slow disc still takes the last words.
    for descriptor in descriptors:
        with contextlib.suppress(OSError):
            os.close(descriptor)
    journal.close()
    sys.exit(0 if in_order else 1)


if __name__ == "__main__":
    main()
