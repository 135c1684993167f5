"""A light source that may have an SC10 shutter: filter wheels and tunable filters."""

import contextlib
from collections.abc import Callable
from typing import TypeVar

from pydantic import Field

from drivers.prompt_line import prompt_framer
from drivers.serial_link import LineRegistry, SerialLink
from drivers.source import LightSource, PortSource, SourceConfig
from drivers.sources import sc10


class ShutteredConfig(SourceConfig):
    """What the rig file says of such a source."""

    shutter: sc10.Config | None = Field(default=None, description="SC10 shutter beside it")


class ShutteredSource(PortSource):
    """Light on and off by the shutter, where there is one."""

    _shutter: LightSource | None

    def interlock_open(self) -> bool:
        """That of the shutter; the source alone has none."""
        return self._shutter is not None and self._shutter.interlock_open()

    def describe(self) -> dict[str, str]:
        """Kind, model and port, the driver's own facts, and the model of the shutter."""
        description = super().describe() | self._facts()
        return description if self._shutter is None else description | {"shutter": self._shutter.describe()["model"]}

    def _facts(self) -> dict[str, str]:
        return {}

    def close(self) -> None:
        """Give the ports back; source and shutter stay as they are."""
        if self._shutter is not None:
            self._shutter.close()
        super().close()


Config = TypeVar("Config", bound=ShutteredConfig)
Source = TypeVar("Source", bound=ShutteredSource)


def open_with_shutter(
    make: Callable[[Config, SerialLink, LightSource | None, LineRegistry], Source],
    config: Config,
    lines: LineRegistry,
    baudrate: int,
) -> Source:
    """Open the source, and the shutter where there is one; changes nothing."""
    with lines.link(config, baudrate, prompt_framer) as link, contextlib.ExitStack() as cleanup:
        shutter: LightSource | None = None
        if config.shutter is not None:
            shutter = sc10.open(config.shutter, lines)
            cleanup.callback(shutter.close)
        source = make(config, link, shutter, lines)
        cleanup.pop_all()
        return source
