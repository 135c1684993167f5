"""Faults of an ordinary bench, each with the effect of `diagnose` that describes it, and the sizes that a lab meets.

`./lab demo` draws from this table, and the catalogue of effects shows an example of each. An effect of `diagnose` that
no fault of the simulated rig produces is not in the table.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from simulators.bench.effects import AnyBenchEffect
from simulators.bench.effects.base import BenchEffect

_READ: TypeAdapter[BenchEffect] = TypeAdapter(AnyBenchEffect)
_PLATES = {"psg": "psg_retarder", "psa": "psa_retarder"}


@dataclass(frozen=True)
class Draw:
    """What varies from one fault of a kind to the next.

    Attributes
    ----------
    size : in the unit of the fault.
    axis : "psg" or "psa".
    order : 1 or 2, periods a turn.
    phase_deg : 0 to 360.
    state : exposure from which on a slip acts.
    """

    size: float
    axis: str
    order: int
    phase_deg: float
    state: int


@dataclass(frozen=True)
class TypicalFault:
    """One kind of fault.

    Attributes
    ----------
    smallest, largest : sizes; drawn evenly in the logarithm.
    unit : of the size, in words.
    settings : the fault as the `effects` of a rig file have it.
    signed : whether the size may be negative.
    mode : of the simulated rig, "drr" or "stokes".
    hidden : why a capture of the default plan cannot show it; empty where it can.
    slow : whether its diagnosis takes longer than three minutes.
    implies : other effects that are true of it as well.
    """

    smallest: float
    largest: float
    unit: str
    settings: Callable[[Draw], dict[str, Any]]
    signed: bool = False
    mode: str = "drr"
    hidden: str = ""
    slow: bool = False
    implies: tuple[str, ...] = ()

    def draw(self, random: np.random.Generator, states: int) -> tuple[BenchEffect, str]:
        """A fault of this kind and its size in words; same random numbers, same fault."""
        size = float(np.exp(random.uniform(np.log(self.smallest), np.log(self.largest))))
        sign = float(random.choice([-1, 1])) if self.signed else 1.0
        axis, order = str(random.choice(list(_PLATES))), int(random.integers(1, 3))
        phase_deg = round(float(random.uniform(0, 360)), 1)
        state = int(random.integers(states // 4, states - states // 4))
        draw = Draw(float(f"{sign * size:.3g}"), axis, order, phase_deg, state)
        settings = self.settings(draw)
        place = settings.get("element") or settings.get("axis")
        description = f"{draw.size:g} {self.unit}" + (f", {place}" if place else "")
        return _READ.validate_python(settings), description

    def example(self) -> BenchEffect:
        """A fault of middle size on the generator's plate."""
        size = float(f"{np.sqrt(self.smallest * self.largest):.1g}")
        return _READ.validate_python(self.settings(Draw(size, "psg", 1, 30.0, 20)))


def _element(element: str, parameter: str) -> Callable[[Draw], dict[str, Any]]:
    return lambda d: {"kind": "element_error", "element": element, "parameter": parameter, "offset": d.size}


def _window(behind: str, azimuth_deg: float | None = None) -> Callable[[Draw], dict[str, Any]]:
    def settings(d: Draw) -> dict[str, Any]:
        at = d.phase_deg / 2 if azimuth_deg is None else azimuth_deg
        return {"kind": "window", "behind": behind, "azimuth_deg": at, "retardance_deg": d.size}

    return settings


def _per_hour(a_minute: float) -> float:
    return float(f"{60 * a_minute:.4g}")


#: By the kind of the effect of `diagnose`.
FAULTS: Mapping[str, TypicalFault] = {
    "psg_retardance": TypicalFault(0.5, 4, "degrees", _element("psg_retarder", "retardance_deg"), signed=True),
    "psa_retardance": TypicalFault(0.5, 4, "degrees", _element("psa_retarder", "retardance_deg"), signed=True),
    "psg_azimuth": TypicalFault(0.1, 1, "degrees", _element("psg_retarder", "azimuth_deg"), signed=True),
    "psa_azimuth": TypicalFault(0.1, 1, "degrees", _element("psa_retarder", "azimuth_deg"), signed=True),
    "analyzer_azimuth": TypicalFault(0.1, 1, "degrees", _element("analyzer", "azimuth_deg"), signed=True),
    "psg_extinction": TypicalFault(0.002, 0.02, "of the light", _element("psg_polarizer", "extinction")),
    "psa_extinction": TypicalFault(0.002, 0.02, "of the light", _element("analyzer", "extinction")),
    "generator_ellipticity": TypicalFault(1, 6, "degrees of retardance", _window("psg_polarizer", 45.0)),
    "path_retardance": TypicalFault(1, 6, "degrees of retardance", _window("psg_retarder")),
    "retarder_diattenuation": TypicalFault(
        0.004, 0.03, "of the light", lambda d: _element(_PLATES[d.axis], "diattenuation")(d), signed=True
    ),
    "retarder_transmission": TypicalFault(
        0.005,
        0.03,
        "of the light",
        lambda d: {
            "kind": "plate_transmission",
            "axis": d.axis,
            "amplitude": d.size,
            "harmonic": d.order,
            "phase_deg": d.phase_deg,
        },
    ),
    "retardance_over_turn": TypicalFault(
        0.3,
        2,
        "degrees",
        lambda d: {
            "kind": "plate_retardance",
            "element": _PLATES[d.axis],
            "amplitude_deg": d.size,
            "phase_deg": d.phase_deg,
        },
    ),
    "retardance_drift": TypicalFault(
        0.7,
        5,
        "degrees a minute",
        lambda d: {"kind": "element_error", "element": _PLATES[d.axis], "per_hour": _per_hour(d.size)},
        signed=True,
        # The plate warms up before the first state too, where the effect begins at the declared value.
        implies=("psg_retardance", "psa_retardance"),
    ),
    "field_retardance": TypicalFault(
        0.5,
        4,
        "degrees at the edge of the image",
        lambda d: {
            "kind": "field_retardance",
            "element": _PLATES[d.axis],
            "edge_deg": d.size,
            "x": round(0.5 * np.cos(np.deg2rad(d.phase_deg)), 2),
            "y": round(0.5 * np.sin(np.deg2rad(d.phase_deg)), 2),
        },
        signed=True,
        slow=True,
    ),
    "stray_light": TypicalFault(1000, 8000, "electrons a second", lambda d: {"kind": "stray_light", "e_per_s": d.size}),
    "rotation_eccentricity": TypicalFault(
        0.1,
        1,
        "degrees",
        lambda d: {
            "kind": "angle_wobble",
            "axis": d.axis,
            "amplitude_deg": d.size,
            "harmonic": d.order,
            "phase_deg": d.phase_deg,
        },
    ),
    "rotation_ratio": TypicalFault(
        2e-4, 2e-3, "relative", lambda d: {"kind": "angle_scale", "axis": d.axis, "scale_error": d.size}, signed=True
    ),
    "rotation_slip": TypicalFault(
        0.2,
        2,
        "degrees",
        lambda d: {"kind": "angle_slip", "axis": d.axis, "at_index": d.state, "slip_deg": d.size},
        signed=True,
    ),
    "rotation_backlash": TypicalFault(
        0.05,
        0.5,
        "degrees",
        lambda d: {"kind": "angle_play", "axis": d.axis, "play_deg": d.size},
        hidden="the states are reached from one side, which makes it an azimuth error",
    ),
    "angle_per_state": TypicalFault(
        0.05,
        0.4,
        "degrees, standard deviation",
        lambda d: {"kind": "angle_jitter", "axis": d.axis, "sigma_deg": d.size},
    ),
    "source_drift": TypicalFault(
        0.01,
        0.08,
        "of the light a minute",
        lambda d: {"kind": "source_drift", "fraction_per_hour": _per_hour(d.size)},
        signed=True,
    ),
    "source_flicker": TypicalFault(
        0.003, 0.02, "of the light, standard deviation", lambda d: {"kind": "source_flicker", "sigma": d.size}
    ),
    "detector_nonlinearity": TypicalFault(
        0.01, 0.06, "lost at full scale", lambda d: {"kind": "nonlinearity", "at_full_scale": d.size}, signed=True
    ),
    "tone_curve": TypicalFault(0.02, 0.1, "gamma - 1", lambda d: {"kind": "tone_curve", "gamma": 1 + d.size}),
    "detector_offset": TypicalFault(
        20,
        200,
        "electrons",
        lambda d: {"kind": "black_offset", "electrons": d.size},
        hidden="the dark states of the default plan measure it",
    ),
    "saturation": TypicalFault(
        2,
        4,
        "times the light",
        lambda d: {"kind": "source_level", "factor": d.size},
        hidden="clipped counts are visible in the frames, and `process reduce` excludes them",
    ),
    "image_drift": TypicalFault(
        0.3,
        1.4,
        "pixels a minute",
        lambda d: {
            "kind": "image_drift",
            "rows_per_hour": _per_hour(d.size * np.sin(np.deg2rad(d.phase_deg))),
            "columns_per_hour": _per_hour(d.size * np.cos(np.deg2rad(d.phase_deg))),
        },
    ),
    "beam_wander": TypicalFault(
        0.15, 0.8, "pixels", lambda d: {"kind": "image_drift", "axis": d.axis, "wedge_pixels": d.size}
    ),
    "channel_gain": TypicalFault(
        1.005,
        1.05,
        "times the light",
        lambda d: {"kind": "channel_error", "channel": "45", "gain": d.size},
        mode="stokes",
    ),
    "channel_azimuth": TypicalFault(0.2, 2, "degrees", _element("micropolarizer_45", "azimuth_deg"), mode="stokes"),
    "channel_extinction": TypicalFault(
        0.002, 0.02, "of the light", _element("micropolarizer_45", "extinction"), mode="stokes"
    ),
    "pixel_crosstalk": TypicalFault(
        0.002, 0.02, "of the light", lambda d: {"kind": "mosaic_crosstalk", "fraction": d.size}, mode="stokes"
    ),
}
