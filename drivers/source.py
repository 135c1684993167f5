"""A light source as the measurement sees it: light on or off, and whether its interlock allows light."""

from __future__ import annotations

from abc import ABC, abstractmethod


class LightSource(ABC):
    """Light that can be shut off for dark states.

    Opening one changes nothing: the light stays as it is found.
    """

    @abstractmethod
    def set_light(self, on: bool) -> None:
        """Let light through or shut it off; returns when the device confirms it.

        Raises
        ------
        DeviceError
            The device refuses, or its state does not follow.
        """

    @abstractmethod
    def is_on(self) -> bool:
        """True if light is let through, as read from the device."""

    @abstractmethod
    def interlock_open(self) -> bool:
        """True if the device's interlock circuit is open; it has shut off the light by itself then."""

    @abstractmethod
    def describe(self) -> dict[str, str]:
        """Kind, model and port as read when it was opened."""

    @abstractmethod
    def close(self) -> None:
        """Release the device; the light stays as it is."""
