"""Statuses that a RunEngine waits for, and work in a thread that completes one."""

import threading
from collections.abc import Callable


class MoveStatus:
    """A status that the RunEngine waits for: done, with or without an error."""

    def __init__(self) -> None:
        self._ended = threading.Event()
        self._error: BaseException | None = None
        self._callbacks: list[Callable[[MoveStatus], None]] = []
        self._lock = threading.Lock()

    @property
    def done(self) -> bool:
        """Whether it has ended."""
        return self._ended.is_set()

    @property
    def success(self) -> bool:
        """Whether it has ended well."""
        return self.done and self._error is None

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        """The error, or None. Raises TimeoutError if it has not ended in time."""
        if not self._ended.wait(timeout):
            raise TimeoutError("not done yet")
        return self._error

    def add_callback(self, callback: "Callable[[MoveStatus], None]") -> None:
        """Have a function called at the end, at once if that has been."""
        with self._lock:
            if not self.done:
                self._callbacks.append(callback)
                return
        callback(self)

    def end(self, error: BaseException | None = None) -> None:
        """Notify all waiting threads and callbacks."""
        with self._lock:
            self._error = error
            self._ended.set()
        for callback in self._callbacks:
            callback(self)


def in_background(work: Callable[[], None]) -> MoveStatus:
    """Run a function in a new thread; its error becomes that of the status."""
    status = MoveStatus()

    def run() -> None:
        try:
            work()
        except BaseException as error:  # noqa: BLE001 - whatever it is, the RunEngine must hear of it
            status.end(error)
        else:
            status.end()

    threading.Thread(target=run, name="bluesky device", daemon=True).start()
    return status
