"""A direction of what is uncertain as an instrument file tells it: the values by effect, and no more.

There are many of them. Written as the effects that a correction has, those of three captures took a file as long as
none is read.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

#: kind[element] at 662 nm in air.h5
LABEL = re.compile(
    r"(?P<kind>[^\s\[]+)(?:\[(?P<element>[^\]]+)\])?(?: at (?P<wavelength_nm>[\d.]+) nm)?(?: in (?P<capture>.+))?"
)


def told(direction: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, float | str]]:
    """The values of effects (as mappings of their fields) by label; values of many states in one text."""
    out: dict[str, dict[str, float | str]] = {}
    for effect in direction:
        values = {name: _number_or_text(p["value"]) for name, p in effect["parameters"].items()}
        label = effect["kind"] + (f"[{effect['element']}]" if effect["element"] else "")
        label += f" at {effect['wavelength_nm']:g} nm" if effect["wavelength_nm"] is not None else ""
        captures = [f" in {name}" for name in effect["captures"]] if effect["scope"] == "capture" else [""]
        out |= {label + where: values for where in captures}
    return out


def read(direction: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The effects, as mappings of their fields, of values by label.

    Raises
    ------
    ValueError : a label is none, or a text has no numbers.
    """
    out = []
    for label, values in direction.items():
        place = LABEL.fullmatch(label)
        if place is None:
            raise ValueError(
                f"{label!r} is not KIND[ELEMENT] at WAVELENGTH nm in CAPTURE, of which KIND alone has to be"
            )
        fields: dict[str, Any] = {"kind": place["kind"], "element": place["element"]}
        if place["wavelength_nm"]:
            fields["wavelength_nm"] = float(place["wavelength_nm"])
        if place["capture"]:
            fields |= {"captures": (place["capture"],), "scope": "capture"}
        # The unit is that of the effect: nobody reads it here.
        fields["parameters"] = {name: {"value": _numbers(value), "unit": ""} for name, value in values.items()}
        out.append(fields)
    return out


def _number_or_text(value: float | Sequence[float]) -> float | str:
    return value if isinstance(value, float) else " ".join(map(str, value))


def _numbers(value: Any) -> Any:
    return tuple(float(one) for one in value.split()) if isinstance(value, str) else value
