"""A light source as the measurement sees it: on or off, its wavelength, and whether its interlock allows light."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping

from pydantic import BaseModel, ConfigDict, Field

from drivers.errors import DeviceError
from drivers.serial_link import LineRegistry


def check_wavelengths(places: Mapping[float, int], title: str, valued_nm: Iterable[float] = ()) -> None:
    """Refuse a rig file that gives one place to two wavelengths, or a value to a wavelength that has no place.

    Parameters
    ----------
    places : wavelength in nm to filter position, terminal or channel.
    title : a place in words.
    valued_nm : wavelengths of the values.

    Raises
    ------
    ValueError
    """
    first: dict[int, float] = {}
    for nm, place in places.items():
        if place in first:
            raise ValueError(f"{title} {place} is that of {first[place]:g} nm and of {nm:g} nm")
        first[place] = nm
    for nm in valued_nm:
        if nm not in places:
            listing = ", ".join(f"{nm:g}" for nm in places)
            raise ValueError(f"percent is given for {nm:g} nm, and the wavelengths are {listing} nm")


class LightSource(ABC):
    """Light that can be shut off for dark states.

    Opening one changes nothing: the light stays as it is found.

    Attributes
    ----------
    selects_wavelength, has_level : bool
        True where `select` and `set_level` work.
    """

    selects_wavelength: bool = False
    has_level: bool = False

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

    def interlock_open(self) -> bool:
        """True if the device's interlock circuit is open; it has shut off the light by itself then.

        False where it has none that could be read.
        """
        return False

    @abstractmethod
    def describe(self) -> dict[str, str]:
        """Kind, model and port as read when it was opened."""

    @abstractmethod
    def close(self) -> None:
        """Release the device; the light stays as it is."""

    def feed(self) -> None:  # noqa: B027 - most devices need nothing
        """Tell a device that shuts the light without a heartbeat that all is well; other devices need nothing.

        Raises
        ------
        DeviceError
        """

    def select(self, wavelength_nm: float) -> None:
        """Choose the wavelength in nm; light that was on is on again at the new one.

        Raises
        ------
        DeviceError
            The source has no such wavelength, or no choice of wavelengths.
        """
        raise DeviceError(
            f"light source, select {wavelength_nm:g} nm",
            "it cannot choose a wavelength",
            "Change the filter or the lamp by hand",
        )

    def set_level(self, percent: float) -> float:
        """Set the brightness of the selected wavelength, 0 to 100 percent, and return what was read back.

        Raises
        ------
        DeviceError
            Outside 0 to 100, read back as something else, or the source has one brightness only.
        """
        raise DeviceError(
            f"light source, set level to {percent:g} %", "it has no level", "Change the exposure or the lamp by hand"
        )


class SourceConfig(BaseModel):
    """What every kind of source behind a port has in a rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: str
    port: str = Field(description="device path, /dev/serial/by-id path or socket://host:port")
    held_by: str | None = Field(default=None, description="program that may hold the port too: its simulator")
    reply_s: float = Field(default=1.0, gt=0, description="longest wait for a reply")


class PortSource(LightSource):
    """A source behind a port; its driver sets these attributes."""

    config: SourceConfig
    _model: str
    _lines: LineRegistry

    def describe(self) -> dict[str, str]:
        """Kind, model and port."""
        return {"kind": self.config.kind, "model": self._model, "port": self.config.port}

    def close(self) -> None:
        """Give the port back; the light stays as it is."""
        self._lines.release(self.config.port)
