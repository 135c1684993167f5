"""What axes, camera and captures have in common as bluesky devices."""

import threading
import time
from typing import Any

from acquisition.rig.rig import Rig

Readings = dict[str, dict[str, Any]]


class BlueskyDevice:
    """What all have: a name, no parent, and a configuration that may be empty."""

    parent = None

    def __init__(self, name: str, rig: Rig, turn: threading.Lock) -> None:
        self.name = name
        self.rig = rig
        #: Held while something moves or is exposed: one thing at a time, as the rig's checks assume.
        self.turn = turn

    def _configuration(self) -> dict[str, tuple[Any, str]]:
        """What changes seldom: value and unit by name."""
        return {}

    def read_configuration(self) -> Readings:
        """What changes seldom, such as a serial number."""
        return readings({f"{self.name}_{key}": value for key, (value, _) in self._configuration().items()})

    def describe_configuration(self) -> Readings:
        """Type and unit of each."""
        return {
            f"{self.name}_{key}": data_key("configuration", (), unit) | _type_of(value)
            for key, (value, unit) in self._configuration().items()
        }


def _type_of(value: Any) -> dict[str, str]:
    return {"dtype": "string"} if isinstance(value, str) else {}


def readings(values: dict[str, Any]) -> Readings:
    """Values by name as `read` gives them, with the time of now."""
    now = time.time()
    return {name: {"value": value, "timestamp": now} for name, value in values.items()}


def data_key(source: str, shape: tuple[int, ...], units: str) -> dict[str, Any]:
    """The entry of `describe` for one value: a number, or an array of a shape."""
    return {"source": source, "dtype": "array" if shape else "number", "shape": list(shape), "units": units}
