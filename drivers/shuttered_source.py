"""A light source that may have an SC10 shutter beside it: filter wheels and tunable filters."""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Protocol, TypeVar

from drivers.clock import Clock
from drivers.prompt_line import prompt_framer
from drivers.serial_link import LineRegistry, SerialLink, Transcript
from drivers.source import LightSource
from drivers.sources import sc10


class ShutteredConfig(Protocol):
    """What the rig file says of such a source."""

    @property
    def port(self) -> str: ...
    @property
    def held_by(self) -> str | None: ...
    @property
    def shutter(self) -> sc10.Config | None: ...


class ShutteredSource(LightSource):
    """What the shutter does for the source, where there is one."""

    def __init__(self, port: str, shutter: LightSource | None, lines: LineRegistry) -> None:
        self._port, self._shutter, self._lines = port, shutter, lines

    def interlock_open(self) -> bool:
        """That of the shutter; the source alone has none."""
        return self._shutter is not None and self._shutter.interlock_open()

    def _with_shutter(self, found: dict[str, str]) -> dict[str, str]:
        return found if self._shutter is None else found | {"shutter": self._shutter.describe()["model"]}

    def close(self) -> None:
        """Give the ports back; source and shutter stay as they are."""
        if self._shutter is not None:
            self._shutter.close()
        self._lines.release(self._port)


Config = TypeVar("Config", bound=ShutteredConfig)
Source = TypeVar("Source", bound=ShutteredSource)


def open_beside(
    make: Callable[[Config, SerialLink, LightSource | None, LineRegistry], Source],
    config: Config,
    lines: LineRegistry,
    baudrate: int,
) -> Source:
    """Open the source, and the shutter where there is one; changes nothing."""
    with (
        lines.taken(config.port, SerialLink, partial(_link, config, baudrate, lines.clock)) as link,
        contextlib.ExitStack() as failed,
    ):
        shutter: LightSource | None = None
        if config.shutter is not None:
            shutter = sc10.open(config.shutter, lines)
            failed.callback(shutter.close)
        source = make(config, link, shutter, lines)
        failed.pop_all()
        return source


def _link(config: ShutteredConfig, baudrate: int, clock: Clock, transcript: Transcript | None) -> SerialLink:
    return SerialLink(config.port, baudrate, prompt_framer, transcript=transcript, clock=clock, held_by=config.held_by)
