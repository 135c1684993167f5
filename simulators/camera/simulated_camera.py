"""What every simulated camera is: a device at a loopback address, plugged in and out, whose exposures may go wrong."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self

from simulators.camera.loopback_address import LoopbackAddress


class SimulatedCamera(ABC):
    """A context manager that runs a camera; it raises at its end what went wrong in an exposure."""

    def __init__(self, address: str, elsewhere: bool) -> None:
        self.address = address
        self._loopback = LoopbackAddress(address, elsewhere)
        self._error: BaseException | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self.stop()
        if error is None:
            self.check()

    @abstractmethod
    def start(self) -> None:
        """Start the camera, also again after `vanish`.

        Raises
        ------
        CameraError
            The address is taken or does not exist.
        """

    @abstractmethod
    def vanish(self) -> None:
        """End the camera at once, as if its plug was pulled; `start` plugs it in again.

        The address stays ours until `stop`: a driver that does not know yet must not talk to another camera there.
        """

    def stop(self) -> None:
        """End the camera and let the next one have its address."""
        self.vanish()
        self._loopback.release()

    def check(self) -> None:
        """Raise what went wrong in an exposure, if anything did."""
        error, self._error = self._error, None
        if error is not None:
            raise error
