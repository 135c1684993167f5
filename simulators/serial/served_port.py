"""Base of the ports that serve an emulator: a thread, a way to stop it, and the error that ended it."""

import os
import threading
from abc import ABC, abstractmethod
from typing import Self


class ServedPort(ABC):
    """A port served in a thread; clients may come and go.

    Attributes
    ----------
    path : path of the port, for the client.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self._wake_read, self._wake_write = os.pipe()
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name=f"emulator {path}", daemon=True)
        self._thread.start()

    @abstractmethod
    def _serve(self) -> None:
        """Serve clients until `_wake_read` can be read."""

    @abstractmethod
    def _release(self) -> None:
        """Close what clients connect to; called again after it is closed."""

    def is_serving(self) -> bool:
        """True until it is closed or the emulator fails."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Stop serving and remove the port. Raises RuntimeError: the emulator itself failed while it served."""
        if self._thread.is_alive():
            os.write(self._wake_write, b"x")
            self._thread.join()
        self._release()
        for descriptor in (self._wake_read, self._wake_write):
            if descriptor >= 0:
                os.close(descriptor)
        self._wake_read = self._wake_write = -1
        error, self._error = self._error, None
        if error is not None:
            raise RuntimeError(f"the emulator on {self.path} failed") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self) -> None:
        try:
            self._serve()
        except BaseException as error:  # noqa: BLE001 - raised again by close()
            # Kept for close(), which raises it in the thread that owns the port.
            self._error = error
