"""Settings that a plan can change, and signals that a suspender can watch, as bluesky devices."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

from acquisition.bluesky_devices.device import BlueskyDevice, Readings, data_key, readings
from acquisition.bluesky_devices.status import MoveStatus, in_background
from acquisition.rig.rig import Rig

log = logging.getLogger(__name__)

#: How often a watched signal is read.
_LOOK_S = 0.2


class SettingDevice(BlueskyDevice):
    """A number that a plan can scan, such as an exposure: `set` changes it, `read` gives it."""

    def __init__(
        self,
        name: str,
        rig: Rig,
        turn: threading.Lock,
        *,
        get: Callable[[], float],
        change: Callable[[float], None],
        unit: str,
    ) -> None:
        super().__init__(name, rig, turn)
        self._get, self._change, self._unit = get, change, unit

    @property
    def hints(self) -> dict[str, Any]:
        """What live tables show."""
        return {"fields": [self.name]}

    @property
    def position(self) -> float:
        """The value now."""
        return self._get()

    def set(self, value: float) -> MoveStatus:
        """Change it. The status fails with what refuses the value."""

        def change() -> None:
            with self.turn:
                self._change(float(value))

        return in_background(change)

    def read(self) -> Readings:
        """The value now."""
        return readings({self.name: self.position})

    def describe(self) -> Readings:
        """Unit of the value."""
        return {self.name: data_key(f"setting {self.name}", (), self._unit)}


class InterlockDevice(BlueskyDevice):
    """The interlock circuit of the source: 1 while it is open. A suspender can watch it.

    Callbacks get `value`, `timestamp` and `obj` by name, as those of ophyd do, whenever the value changes.
    """

    def __init__(self, name: str, rig: Rig, turn: threading.Lock) -> None:
        super().__init__(name, rig, turn)
        self._watchers: list[Callable[..., Any]] = []
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None
        self._last = 0

    def get(self) -> int:
        """1 while the circuit is open, else 0; 0 without a source that has one."""
        source = self.rig.source
        return int(source is not None and source.interlock_open())

    @property
    def is_watched(self) -> bool:
        """Whether a function is to be called."""
        return bool(self._watchers)

    def read(self) -> Readings:
        """The circuit now."""
        return readings({self.name: self.get()})

    def describe(self) -> Readings:
        """What the number means."""
        return {self.name: data_key("interlock circuit of the source, 1: open", (), "") | {"dtype": "integer"}}

    def subscribe(self, function: Callable[..., Any], event_type: object = None, run: bool = True) -> None:
        """Call a function now (`run`) and whenever the circuit opens or closes."""
        with self._lock:
            self._watchers.append(function)
            if self._thread is None:
                self._last = self.get()
                self._ended.clear()
                self._thread = threading.Thread(target=self._watch, name="bluesky interlock", daemon=True)
                self._thread.start()
            now = self._last
        if run:
            function(value=now, timestamp=time.time(), obj=self)

    def clear_sub(self, function: Callable[..., Any]) -> None:
        """Call a function no more."""
        with self._lock:
            if function in self._watchers:
                self._watchers.remove(function)
            watched = bool(self._watchers)
        if not watched:
            self.close()

    def close(self) -> None:
        """Watch no more."""
        self._ended.set()
        thread, self._thread = self._thread, None
        if thread is not None and thread is not threading.current_thread():
            thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK_S):
            now = self.get()
            with self._lock:
                changed, self._last = now != self._last, now
                watchers = list(self._watchers)
            for function in watchers if changed else ():
                try:
                    function(value=now, timestamp=time.time(), obj=self)
                except Exception:
                    # A suspender fails while its RunEngine cannot be suspended; it has to hear of the end all the same.
                    log.exception("%s: a watcher failed", self.name)
