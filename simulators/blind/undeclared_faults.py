"""Faults of a lab that a declared model lacks, by physics; each changes a TrueBench and returns the truth.

`LISTED` are causes that `processing/effects` knows, by its kinds; `UNLISTED` are causes that it does not know. A truth
is (kind, place, parameters in the units of the effect): only what can be compared number by number.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.ndimage import gaussian_filter

from processing.arrays import Array
from simulators.blind.undeclared_captures import TrueBench


@dataclass(frozen=True)
class Truth:
    """A fault of a bench, for the truth file."""

    kind: str
    place: str = ""
    parameters: dict[str, float] = field(default_factory=dict)


#: Least and largest size; drawn evenly in the logarithm.
Sizes = tuple[float, float]


Fault = Callable[[TrueBench, np.random.Generator, int], Truth]


class SizedFault(Protocol):
    """A fault whose size can be drawn from elsewhere than the blind suite's own range."""

    def __call__(self, bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = ...) -> Truth: ...


def draw_signed(random: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))) * random.choice([-1, 1]))


def draw_size(random: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def draw_axis(bench: TrueBench, random: np.random.Generator) -> str:
    if bench.axis is not None:
        return bench.axis
    return "psg" if bench.mosaic else str(random.choice(["psg", "psa"]))


def _number(name: str, attribute: str, place: str, parameter: str, *, low: float, high: float) -> SizedFault:
    def fault(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (low, high)) -> Truth:
        value = draw_signed(random, *sizes)
        setattr(bench, attribute, getattr(bench, attribute) + np.deg2rad(value))
        return Truth(name, place, {parameter: value})

    return fault


def _extinction(name: str, attribute: str, place: str) -> SizedFault:
    def fault(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.001, 0.03)) -> Truth:
        value = draw_size(random, *sizes)
        setattr(bench, attribute, value)
        return Truth(name, place, {"extinction": value})

    return fault


def retarder_diattenuation(
    bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.002, 0.05)
) -> Truth:
    axis, d = draw_axis(bench, random), draw_signed(random, *sizes)
    setattr(bench, "fast_slow_g" if axis == "psg" else "fast_slow_a", (1 + d, 1 - d))
    return Truth("retarder_diattenuation", f"{axis}_retarder", {"diattenuation": d})


def retarder_transmission(
    bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.002, 0.03)
) -> Truth:
    axis, order, size, phase = (
        draw_axis(bench, random),
        int(random.choice([1, 2])),
        draw_size(random, *sizes),
        random.uniform(0, 2 * np.pi),
    )
    bench.level.append(lambda k, a: 1 + size * np.cos(order * a[axis] - phase))
    values = {f"cos_{order}": size * np.cos(phase), f"sin_{order}": size * np.sin(phase)}
    return Truth("retarder_transmission", f"{axis}_retarder", values)


def field_retardance(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.3, 4.0)) -> Truth:
    # Rays at an angle: retardance grows with the squared tilt about a centre that need not be the image's.
    size, x0, y0 = draw_signed(random, *sizes), *random.uniform(-0.7, 0.7, 2)
    y, x = np.mgrid[-1 : 1 : bench.rows * 1j, -1 : 1 : bench.columns * 1j]
    tilt = (x - x0) ** 2 + (y - y0) ** 2
    bench.field_retardance = np.deg2rad(size * (tilt - (2 / 3 + x0**2 + y0**2)))
    values = {"x": -2 * size * x0, "y": -2 * size * y0, "x2": size, "xy": 0.0, "y2": size}
    return Truth("field_retardance", "psg_retarder", values)


def retardance_drift(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.3, 4.0)) -> Truth:
    # A plate that warms up comes to rest like an exponential.
    axis, size, rate = draw_axis(bench, random), np.deg2rad(draw_signed(random, *sizes)), random.uniform(1, 3)

    def warm(k: int, a: dict[str, float]) -> tuple[float, float]:
        change = float(size * (1 - np.exp(-rate * k / (states - 1))))
        return (change, 0.0) if axis == "psg" else (0.0, change)

    bench.retardance.append(warm)
    return Truth("retardance_drift", f"{axis}_retarder")


def retardance_over_turn(
    bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.1, 2.0)
) -> Truth:
    # A wedged plate that the beam meets beside the axis.
    axis, size, phase = draw_axis(bench, random), draw_size(random, *sizes), random.uniform(0, 2 * np.pi)

    def turned(k: int, a: dict[str, float]) -> tuple[float, float]:
        change = float(np.deg2rad(size) * np.cos(a[axis] - phase))
        return (change, 0.0) if axis == "psg" else (0.0, change)

    bench.retardance.append(turned)
    values = {"cos": size * np.cos(phase), "sin": size * np.sin(phase)}
    return Truth("retardance_over_turn", f"{axis}_retarder", values)


def stray_light(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.003, 0.05)) -> Truth:
    # Follows the scene's brightness (light past the analyzer), the same in every state.
    size = draw_size(random, *sizes)
    bench.shared_light = size
    return Truth("stray_light", "", {"fraction": size})


def path_retardance(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.2, 4.0)) -> Truth:
    size, t = np.deg2rad(draw_size(random, *sizes)), random.uniform(0, np.pi)
    bench.path = (size * np.cos(2 * t), size * np.sin(2 * t))
    a, b = np.rad2deg(bench.path)
    return Truth("path_retardance", "", {"at_0": float(a), "at_45": float(b)})


def rotation_eccentricity(
    bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.04, 1.0)
) -> Truth:
    axis, d, phase = draw_axis(bench, random), draw_size(random, *sizes), random.uniform(0, 2 * np.pi)
    names = ("cos_1", "sin_1", "cos_2", "sin_2")
    if random.random() < 0.5:
        size = np.deg2rad(d)
        # A scale of radius 1 centred a little beside the shaft is read at one point.
        bench.angles.append(lambda k, a: a | {axis: a[axis] + np.arcsin(size * np.cos(a[axis] - phase))})
        values = (d * np.cos(phase), d * np.sin(phase), 0.0, 0.0)
    else:
        # A joint whose shafts meet at an angle (8 degrees at most) leads and lags twice a turn, by tan^2(angle / 2).
        d *= 0.3
        size = np.deg2rad(d)
        bend = (1 - size) / (1 + size)

        def joint(k: int, a: dict[str, float]) -> dict[str, float]:
            t = a[axis] - phase
            return a | {axis: a[axis] + np.arctan2(np.sin(t) * bend, np.cos(t)) - np.arctan2(np.sin(t), np.cos(t))}

        bench.angles.append(joint)
        # atan(b tan t) - t = -size sin 2t + size^2/2 sin 4t - ..., with b = (1 - size)/(1 + size).
        values = (0.0, 0.0, d * np.sin(2 * phase), -d * np.cos(2 * phase))
    return Truth("rotation_eccentricity", axis, dict(zip(names, map(float, values), strict=True)))


def rotation_ratio(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (1e-4, 2e-3)) -> Truth:
    axis, size = draw_axis(bench, random), draw_signed(random, *sizes)
    bench.angles.append(lambda k, a: a | {axis: a[axis] * (1 + size)})
    return Truth("rotation_ratio", axis, {"relative": size})


def rotation_backlash(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.05, 0.5)) -> Truth:
    axis, play = draw_axis(bench, random), np.deg2rad(draw_size(random, *sizes))
    last: dict[str, float] = {}

    def lag(k: int, a: dict[str, float]) -> dict[str, float]:
        # The shaft follows only when the play is taken up.
        if k == 0:
            last["shaft"] = a[axis] - play
        last["shaft"] = min(max(last["shaft"], a[axis] - play), a[axis] + play)
        return a | {axis: last["shaft"]}

    bench.angles.append(lag)
    bench.zigzag = True
    return Truth("rotation_backlash", axis, {"backlash": float(np.rad2deg(play))})


def rotation_slip(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.1, 3.0)) -> Truth:
    axis, size, first = draw_axis(bench, random), draw_signed(random, *sizes), int(random.integers(4, states - 3))
    bench.angles.append(lambda k, a: a | {axis: a[axis] + np.deg2rad(size) * (k >= first)})
    return Truth("rotation_slip", f"{axis}@{first}", {"slip": size})


def angle_per_state(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.05, 0.5)) -> Truth:
    axis = draw_axis(bench, random)
    error = np.deg2rad(draw_size(random, *sizes)) * random.standard_normal(states)
    bench.angles.append(lambda k, a: a | {axis: a[axis] + error[k]})
    return Truth("angle_per_state", axis)


def source_drift(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.003, 0.1)) -> Truth:
    size = draw_signed(random, *sizes)
    times = np.arange(states) / (states - 1)
    if random.random() < 0.5:
        times = busy_machine(bench, random, states)
    bench.level.append(lambda k, a: 1 + size * (times[k] - 0.5))
    return Truth("source_drift", "", {"fraction": size})


def busy_machine(bench: TrueBench, random: np.random.Generator, states: int) -> Array:
    """Times (N,), 0 to 1, at which a loaded machine takes the states; it stamps them up to 100 ms late."""
    waits = 2.0 + random.exponential(random.choice([0.1, 1.0, 5.0]), states)
    bench.times_s = np.cumsum(waits) - waits[0]
    bench.late_s = random.exponential(random.choice([0.002, 0.03]), states)
    return np.asarray(bench.times_s / bench.times_s[-1])


def source_flicker(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.002, 0.02)) -> Truth:
    level = 1 + draw_size(random, *sizes) * random.standard_normal(states)
    bench.level.append(lambda k, a: float(level[k]))
    return Truth("source_flicker")


def detector_nonlinearity(
    bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.004, 0.06)
) -> Truth:
    c, top = draw_signed(random, *sizes), 65435.0 * bench.gain
    bench.transfer.append(lambda e: e * (1 - c * e / top))
    return Truth("detector_nonlinearity", "", {"lost_at_full_scale": c})


def detector_offset(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (30, 600)) -> Truth:
    counts = draw_signed(random, *sizes)
    bench.transfer.append(lambda e: e + counts * bench.gain)
    return Truth("detector_offset", "", {"offset": counts})


def saturation(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (1.03, 1.4)) -> Truth:
    bench.electrons = bench.full_well * random.uniform(*sizes)
    return Truth("saturation")


def image_drift(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.1, 1.0)) -> Truth:
    x, y = draw_signed(random, *sizes), draw_signed(random, *sizes)
    bench.shift.append(lambda k, a: (x * k / (states - 1), y * k / (states - 1)))
    return Truth("image_drift", "", {"x": x, "y": y})


def beam_wander(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.1, 1.0)) -> Truth:
    axis, size, phase = draw_axis(bench, random), draw_size(random, *sizes), random.uniform(0, 2 * np.pi)
    bench.shift.append(lambda k, a: (size * np.cos(a[axis] - phase), size * np.sin(a[axis] - phase)))
    s, c = size * np.sin(phase), size * np.cos(phase)
    return Truth("beam_wander", f"{axis}_retarder", {"x_cos": c, "x_sin": s, "y_cos": -s, "y_sin": c})


def tone_curve(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.01, 0.15)) -> Truth:
    e, top = draw_signed(random, *sizes), 65435.0 * bench.gain
    bench.transfer.append(lambda x: top * (np.maximum(x, 0) / top) ** (1 / (1 + e)))
    return Truth("tone_curve", "", {"gamma_minus_1": e})


LISTED: dict[str, SizedFault] = {
    "psg_retardance": _number("psg_retardance", "dg", "psg_retarder", "retardance", low=0.1, high=4.0),
    "psa_retardance": _number("psa_retardance", "da", "psa_retarder", "retardance", low=0.1, high=4.0),
    "psg_azimuth": _number("psg_azimuth", "og", "psg_retarder", "azimuth", low=0.03, high=1.0),
    "psa_azimuth": _number("psa_azimuth", "oa", "psa_retarder", "azimuth", low=0.03, high=1.0),
    "analyzer_azimuth": _number("analyzer_azimuth", "lp", "", "azimuth", low=0.03, high=1.0),
    "psg_extinction": _extinction("psg_extinction", "extinction_g", "psg_polarizer"),
    "psa_extinction": _extinction("psa_extinction", "extinction_a", "analyzer"),
    "generator_ellipticity": _number(
        "generator_ellipticity", "ellipticity", "psg_polarizer", "ellipticity", low=0.1, high=2.0
    ),
    "retarder_diattenuation": retarder_diattenuation,
    "retarder_transmission": retarder_transmission,
    "field_retardance": field_retardance,
    "retardance_drift": retardance_drift,
    "retardance_over_turn": retardance_over_turn,
    "stray_light": stray_light,
    "path_retardance": path_retardance,
    "rotation_eccentricity": rotation_eccentricity,
    "rotation_ratio": rotation_ratio,
    "rotation_backlash": rotation_backlash,
    "rotation_slip": rotation_slip,
    "angle_per_state": angle_per_state,
    "source_drift": source_drift,
    "source_flicker": source_flicker,
    "detector_nonlinearity": detector_nonlinearity,
    "detector_offset": detector_offset,
    "saturation": saturation,
    "image_drift": image_drift,
    "beam_wander": beam_wander,
    "tone_curve": tone_curve,
}


def etalon(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Parallel faces between retarder and polarizer: fringes that run through many orders as the plate turns."""
    size, order, phase = draw_size(random, 0.004, 0.03), random.uniform(3.3, 7.7), random.uniform(0, 6)
    bench.level.append(lambda k, a: 1 / (1 + size * np.sin(order * a["psg"] + phase) ** 2))
    return Truth("etalon")


def swapped_frames(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Two frames stored in each other's place."""
    order = np.arange(states)
    i = int(random.integers(0, states - 4))
    j = i + int(random.integers(1, 4))
    order[[i, j]] = order[[j, i]]
    bench.order = order
    return Truth("swapped_frames")


def fly(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """A dark spot that sits on the sample for five states, walking a little."""
    first, radius = int(random.integers(0, states - 5)), random.uniform(1.5, 4)
    x0, y0 = random.uniform(6, bench.columns - 6), random.uniform(6, bench.rows - 6)
    y, x = np.mgrid[0 : bench.rows, 0 : bench.columns]

    def shadow(k: int, e: Array) -> Array:
        on = first <= k < first + 5
        step = k - first
        return np.asarray(e * (1 - 0.6 * on * (np.hypot(x - x0 - step, y - y0 + step) < radius)))

    bench.light.append(shadow)
    return Truth("fly")


def pressure_wave(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """A door is slammed: for a few states the air refracts, and the image is warped in ripples."""
    first, size, length = int(random.integers(0, states - 6)), random.uniform(0.3, 1.5), random.uniform(5, 12)
    y, x = np.mgrid[0 : bench.rows, 0 : bench.columns].astype(float)

    def warp(k: int, a: dict[str, float]) -> tuple[Array, Array]:
        on = size * (first <= k < first + 6)
        return on * np.sin(2 * np.pi * x / length + k), on * np.cos(2 * np.pi * y / length - k)

    bench.shift.append(warp)
    return Truth("pressure_wave")


def broad_source(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The source has a band, and the retardance goes as one over the wavelength."""
    half = random.uniform(0.03, 0.12)
    bench.band = 1 / np.linspace(1 - half, 1 + half, 9)
    return Truth("broad_source")


def drying_sample(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """One of the sample's materials gets brighter or darker while it is measured."""
    size, material = draw_signed(random, 0.02, 0.2), int(random.integers(4))
    bench.material_level.append((material, lambda k: 1 + size * (1 - np.exp(-3 * k / states))))
    return Truth("drying_sample")


def defocus(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The lens creeps out of focus during the capture."""
    size = random.uniform(0.6, 2.0)

    def blur(k: int, e: Array) -> Array:
        return np.asarray(gaussian_filter(e, size * k / states, mode="nearest"))

    bench.light.append(blur)
    return Truth("defocus")


def lamp_beat(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The lamp's ripple beats with the exposure. In truth a gain for each state: `source_flicker` is a right name."""
    size, rate, phase = draw_size(random, 0.004, 0.03), random.uniform(0.3, 2.8), random.uniform(0, 6)
    bench.level.append(lambda k, a: 1 + size * np.sin(rate * k + phase))
    return Truth("lamp_beat")


def banding(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The read-out's reference wanders: every row of every frame has its own offset."""
    size = random.uniform(15, 120)
    offsets = size * random.standard_normal((states, bench.rows, 1))
    bench.light.append(lambda k, e: e + offsets[k])
    return Truth("banding")


UNLISTED: dict[str, Fault] = {
    f.__name__: f
    for f in (etalon, swapped_frames, fly, pressure_wave, broad_source, lamp_beat, banding, drying_sample, defocus)
}
