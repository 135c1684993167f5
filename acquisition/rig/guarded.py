"""What `acquire` does for its guard (acquisition/rig/guard.py): no light without a guard that watches."""

import contextlib
import json
import os
import select
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from acquisition.errors import RunFailed
from acquisition.rig.config import RigConfig
from acquisition.rig.guard import LATE_S, LOOK_S, SILENT_KILL_S, SILENT_SHUT_S, is_stopped
from drivers.source import LightSource
from processing.yaml_file import dump_yaml

#: The guard's journal, next to the captures.
GUARD_LOG = "guard.jsonl"
#: Time between two beats.
BEAT_S = 0.1
#: Longest wait for the guard's end, and for a guard to begin: another Python program, on a machine that may be busy.
END_S = 2.0
START_S = 60.0
#: Guards that may be lost in a row before nothing is lit any more.
MOST_LOST = 5
#: A guard that watched for so long counts as well again.
WELL_S = 60.0

#: Guards that go on after this program has given the light to them; a handle that is dropped complains.
_on_duty: list[subprocess.Popen[bytes]] = []


class Guarding:
    """Starts the guard of a rig, beats for it, hears it beat, and starts another one when it is lost.

    When the guard dies, is stopped, or says nothing, the light is shut at once and `losses` counts one more. Light
    is switched on again when a guard has confirmed that it watches.

    Parameters
    ----------
    ports : descriptors of the rig's open ports, by real path.
    shut : shuts the light; raises DeviceError.
    tell : hears of every loss at once, from another thread.

    Attributes
    ----------
    losses : how often the light was shut because the guard, or this process, was not heard.
    """

    def __init__(
        self,
        config: RigConfig,
        journal: Path | None,
        ports: dict[str, int],
        shut: Callable[[], None],
        *,
        tell: Callable[[str], None],
    ) -> None:
        self._config, self.journal, self._ports = config, journal, ports
        self._shut, self._tell = shut, tell
        self.losses = 0
        self._hopeless: str | None = None
        self._is_dark_due = False
        self._watching = threading.Event()
        self._ended = threading.Event()
        #: The guard that watches now; another one takes the place of one that was lost.
        self.process: subprocess.Popen[bytes] | None = None
        self._line: socket.socket | None = None
        self._tail = b""
        self._heart = threading.Thread(target=self._live, name="heartbeat", daemon=True)
        self._heart.start()

    def require(self) -> None:
        """Return when a guard watches. Raises RunFailed if none begins in START_S, or the light could not be shut."""
        if self._hopeless is not None or not self._watching.wait(START_S):
            raise RunFailed(
                f"no guard confirms that it watches ({self._hopeless or f'no answer in {START_S:g} s'}). The light "
                "stays off. Free memory or processes, then continue with --resume."
            )
        if self._is_dark_due:
            raise RunFailed("the light could not be shut when the guard was lost. Look at the source and its cable.")

    def say_failed(self, text: str) -> None:
        """Run the rig's alert command."""
        if self._watching.wait(END_S):
            self._say({"failed": text.replace("\n", " ")})

    def end(self, take_over: str | None) -> bool:
        """End in order; False if a guard should take over and there is none.

        Parameters
        ----------
        take_over : what this process could not do; the guard goes on trying after this process has ended.
        """
        if take_over is not None and self._hopeless is None:
            self._watching.wait(START_S)
        self._ended.set()
        self._heart.join()
        self._say({"rest": True} if take_over is None else {"take_over": take_over})
        guard, self.process = self.process, None
        if self._line is not None:
            if take_over is not None:
                # A line that closes early could be read as this process's death, which comes to the same.
                with contextlib.suppress(OSError):
                    self._line.shutdown(socket.SHUT_WR)
            self._line.close()
        if guard is None:
            return take_over is None
        if take_over is not None:
            _on_duty.append(guard)
            return True
        try:
            guard.wait(END_S)
        except subprocess.TimeoutExpired:
            guard.kill()
            guard.wait()
        return True

    # --- the heart ---------------------------------------------------------------------------------------

    def _live(self) -> None:
        losses, before = 0, ""
        while not self._ended.is_set():
            begin_s = time.monotonic()
            try:
                reason = self._start(before) or self._beat()
            except Exception as error:  # noqa: BLE001 - no guard: whatever it was, the light is shut
                reason = f"{type(error).__name__}: {error}"
            if self._ended.is_set() and reason == "":
                return
            self._watching.clear()
            # What is lost must not act in the middle of the next one's watch.
            if self.process is not None:
                self.process.kill()
            self._dark(f"the guard was lost ({reason}): the light was shut, another guard is started")
            self._drop()
            before = reason
            losses = 1 if time.monotonic() - begin_s > WELL_S else losses + 1
            if losses > MOST_LOST:
                self._hopeless = f"{losses} guards in a row were lost, the last: {reason}"
                return

    def _start(self, before: str) -> str:
        """Start a guard and wait until it watches; returns why it does not, or an empty text."""
        ours, theirs = socket.socketpair()
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "acquisition.rig.guard", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # Alarms come to a terminal; whoever reads a pipe would wait for the guard's end.
                stderr=None if os.isatty(2) else subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                start_new_session=True,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
            )
        finally:
            theirs.close()
        self._line, self._tail = ours, b""
        socket.send_fds(ours, [b"\0"], list(self._ports.values()))
        hello = {
            "rig": dump_yaml(self._config),
            "pid": os.getpid(),
            "log": None if self.journal is None else str(self.journal),
            "ports": list(self._ports),
            "before": before,
        }
        ours.sendall(json.dumps(hello).encode() + b"\n")
        end_s = time.monotonic() + START_S
        while time.monotonic() < end_s and not self._ended.is_set():
            messages = self._receive(LOOK_S)
            if messages is None:
                return self._describe_end()
            if any("watching" in message for message in messages):
                self._watching.set()
                return ""
        return "" if self._ended.is_set() else f"it did not begin in {START_S:g} s"

    def _beat(self) -> str:
        """Beat until the end; returns an empty text then, or why the guard is lost."""
        number, silent_s, is_dark = 0, 0.0, False
        before_s = beat_s = time.monotonic()
        while not self._ended.is_set():
            now_s = time.monotonic()
            if now_s - beat_s >= BEAT_S:
                number, beat_s = number + 1, now_s
                self._say({"beat": number})
            messages = self._receive(LOOK_S)
            now_s = time.monotonic()
            if messages is None:
                return self._describe_end()
            silent_s = 0.0 if messages else silent_s + min(now_s - before_s, LATE_S)
            before_s = now_s
            for message in messages:
                if "shut" in message:
                    self._dark(f"{message['shut']}: it has shut the light")
            if self._is_dark_due and self._try_dark() is None:
                self._tell("the light has been shut")
            assert self.process is not None
            if silent_s > SILENT_KILL_S:
                return f"it was silent for {SILENT_KILL_S:g} s"
            silent = is_stopped(self.process.pid) or silent_s > SILENT_SHUT_S
            if silent and not is_dark:
                is_dark = True
                self._watching.clear()
                self._dark("the guard is stopped or silent: the light is shut until it is heard again")
            elif is_dark and messages and not silent:
                is_dark = False
                self._watching.set()
                self._tell("the guard is heard again")
        return ""

    def _dark(self, why: str) -> None:
        """Light first, then words; a light that does not obey is tried again until it does."""
        self.losses += 1
        problem = self._try_dark()
        self._tell(why if problem is None else f"{why}. THE LIGHT IS NOT SHUT, it is tried again: {problem}")

    def _try_dark(self) -> str | None:
        self._is_dark_due = True
        try:
            self._shut()
        except Exception as error:  # noqa: BLE001 - whatever it was, it is tried again, and the words must come
            return str(error) or type(error).__name__
        self._is_dark_due = False
        return None

    def _receive(self, wait_s: float) -> list[dict[str, object]] | None:
        """Messages of the guard in this time; None if it has ended."""
        assert self._line is not None
        if not select.select([self._line], [], [], wait_s)[0]:
            return []
        try:
            data = self._line.recv(1 << 16)
        except OSError:
            data = b""
        if not data:
            return None
        *lines, self._tail = (self._tail + data).split(b"\n")
        return [json.loads(line) for line in lines]

    def _say(self, message: dict[str, object]) -> None:
        with contextlib.suppress(OSError):
            if self._line is not None:
                self._line.send(json.dumps(message).encode() + b"\n", socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)

    def _describe_end(self) -> str:
        guard = self.process
        if guard is None:
            return "it did not begin"
        try:
            code = guard.wait(END_S)
        except subprocess.TimeoutExpired:
            return "it closed the line"
        return f"it ended with code {code}" if code >= 0 else f"it was killed by signal {-code}"

    def _drop(self) -> None:
        if self.process is not None:
            # One that a tracer or a container holds ends when it is let go.
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(END_S)
        if self._line is not None:
            self._line.close()
        self.process = self._line = None


class WatchedSource(LightSource):
    """A light source that is switched on only while the guard watches, by one thread at a time.

    Attributes
    ----------
    inner : the source itself.
    is_lit : True once this program has switched it on, or tried to; False when it has confirmed that it is off.
    disobeyed : why the light could not be shut at the last try, or None.
    """

    def __init__(self, inner: LightSource, require: Callable[[], None]) -> None:
        self.inner, self._require = inner, require
        self.selects_wavelength, self.has_level = inner.selects_wavelength, inner.has_level
        self.is_lit = False
        self.disobeyed: str | None = None
        self._lock = threading.RLock()

    def set_light(self, on: bool) -> None:
        """Switch on once a guard watches, or off at once. Raises RunFailed without a guard, DeviceError."""
        if on:
            self._require()
        with self._lock:
            if on:
                self.is_lit = True
            try:
                self.inner.set_light(on)
            except BaseException as error:
                if not on:
                    self.disobeyed = str(error) or type(error).__name__
                raise
            if not on:
                self.is_lit, self.disobeyed = False, None

    def select(self, wavelength_nm: float) -> None:
        """As the source does."""
        with self._lock:
            self.inner.select(wavelength_nm)

    def set_level(self, percent: float) -> float:
        """As the source does."""
        with self._lock:
            return self.inner.set_level(percent)

    def is_on(self) -> bool:
        """As the source does."""
        with self._lock:
            return self.inner.is_on()

    def interlock_open(self) -> bool:
        """As the source does."""
        with self._lock:
            return self.inner.interlock_open()

    def describe(self) -> dict[str, str]:
        """As the source does."""
        return self.inner.describe()

    def close(self) -> None:
        """As the source does."""
        self.inner.close()
