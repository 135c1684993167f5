"""More faults that `processing/instrument/effects` does not know, by physics, at sizes of a lab.

The first nine are in `undeclared_faults.UNLISTED`. Each changes a TrueBench and returns the truth.
"""

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from processing.arrays import Array
from simulators.blind.undeclared_captures import TrueBench
from simulators.blind.undeclared_faults import Fault, Truth, draw_axis, draw_signed, draw_size


def _grid(bench: TrueBench) -> tuple[Array, Array]:
    """Rows and columns of all pixels."""
    y, x = np.mgrid[0 : bench.rows, 0 : bench.columns].astype(float)
    return y, x


def _spot(bench: TrueBench, random: np.random.Generator) -> tuple[float, float, float]:
    """Centre (row, column) and radius of a spot, the radius between 0.1 and 0.3 of the image width."""
    y, x = random.uniform(0.25, 0.75, 2) * (bench.rows, bench.columns)
    return float(y), float(x), float(random.uniform(0.1, 0.3) * bench.columns)


def drifting_spot(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """A part of the sample is lit by another lamp, which drifts."""
    y, x = _grid(bench)
    y0, x0, radius = _spot(bench, random)
    spot = np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * radius**2))
    size = draw_signed(random, 0.01, 0.05)
    bench.light.append(lambda k, e: e * (1 + size * spot * (k / (states - 1) - 0.5)))
    return Truth("drifting_spot")


def image_lag(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """A part of the charge of a frame is read with the next one."""
    size = draw_size(random, 0.003, 0.02)
    bench.transfer.append(lambda e: (1 - size) * e + size * np.concatenate([e[:1], e[:-1]]))
    return Truth("image_lag")


def lamp_jump(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The lamp's arc jumps to another place and stays there. In truth a gain for each state."""
    size, first = draw_signed(random, 0.003, 0.03), int(random.integers(5, states - 5))
    bench.level.append(lambda k, a: 1 + size * (k >= first))
    return Truth("lamp_jump")


def focus_breathing(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The magnification follows the turning plate, whose faces are not flat."""
    axis, size, phase = draw_axis(bench, random), draw_size(random, 0.002, 0.015), random.uniform(0, 2 * np.pi)
    y, x = _grid(bench)
    y, x = y - (bench.rows - 1) / 2, x - (bench.columns - 1) / 2

    def breathe(k: int, a: dict[str, float]) -> tuple[Array, Array]:
        grown = size * np.cos(2 * a[axis] - phase)
        return grown * x, grown * y

    bench.shift.append(breathe)
    return Truth("focus_breathing")


def ghost(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Light that is reflected twice in a turning plate with a wedge: a weak second image, which goes round."""
    size, radius, phase = draw_size(random, 0.005, 0.03), random.uniform(2, 8), random.uniform(0, 2 * np.pi)
    y, x = _grid(bench)

    def add(k: int, e: Array) -> Array:
        turn = 2 * np.pi * k / states + phase
        image = map_coordinates(e, [y - radius * np.sin(turn), x - radius * np.cos(turn)], order=1, mode="nearest")
        return np.asarray((1 - size) * e + size * image)

    bench.light.append(add)
    return Truth("ghost")


def tilted_plate(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """A plate that is tilted in its mount: its retardance goes once up and down in half a turn."""
    axis, size, phase = draw_axis(bench, random), np.deg2rad(draw_size(random, 0.2, 2.0)), random.uniform(0, 2 * np.pi)
    turn = 2 * np.pi / states * (1 if axis == "psg" else 4.91)

    def nod(k: int, a: dict[str, float]) -> tuple[float, float]:
        change = float(size * np.cos(2 * turn * k - phase))
        return (change, 0.0) if axis == "psg" else (0.0, change)

    bench.retardance.append(nod)
    return Truth("tilted_plate")


def turning_shadow(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Dust on a turning plate that is nearly in focus."""
    depth, radius, phase = draw_size(random, 0.01, 0.1), random.uniform(0.08, 0.2), random.uniform(0, 2 * np.pi)
    y, x = _grid(bench)

    def shade(k: int, e: Array) -> Array:
        turn = 2 * np.pi * k / states + phase
        x0, y0 = (0.5 + 0.3 * np.cos(turn)) * bench.columns, (0.5 + 0.3 * np.sin(turn)) * bench.rows
        near = np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (2 * (radius * bench.columns) ** 2))
        return np.asarray(e * (1 - depth * near))

    bench.light.append(shade)
    return Truth("turning_shadow")


def rolling_rows(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Rows are exposed one after another under a lamp whose ripple is not synchronous with the frames."""
    size, periods = draw_size(random, 0.003, 0.02), random.uniform(1.3, 5)
    phase = random.uniform(0, 2 * np.pi, states)
    rows = 2 * np.pi * periods * np.linspace(0, 1, bench.rows)[:, None]
    bench.light.append(lambda k, e: e * (1 + size * np.sin(rows + phase[k])))
    return Truth("rolling_rows")


def bubbles(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Small bubbles rise through a cell of liquid in front of the sample."""
    y, x = _grid(bench)
    start = random.uniform(0, 1, (4, 2)) * (bench.rows, bench.columns)
    speed, radius = random.uniform(0.3, 2.0, 4), random.uniform(1.0, 2.5, 4)
    depth = draw_size(random, 0.05, 0.4)

    def rise(k: int, e: Array) -> Array:
        for (y0, x0), v, r in zip(start, speed, radius, strict=True):
            e = e * (1 - depth * (np.hypot(x - x0, y - (y0 - v * k) % bench.rows) < r))
        return e

    bench.light.append(rise)
    return Truth("bubbles")


def stage_drift(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The sample's stage turns slowly about the line of sight: the image turns, and its polarization with it."""
    size = np.deg2rad(draw_signed(random, 0.1, 1.5))
    bench.turned.append(lambda k: float(size * (k / (states - 1) - 0.5)))
    return Truth("stage_drift")


def breathing_blur(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The image gets sharper and softer as a plate turns."""
    size, phase = random.uniform(0.4, 1.2), random.uniform(0, 2 * np.pi)

    def blur(k: int, e: Array) -> Array:
        return np.asarray(gaussian_filter(e, size * np.cos(2 * np.pi * k / states + phase) ** 2, mode="nearest"))

    bench.light.append(blur)
    return Truth("breathing_blur")


OUTSIDE: dict[str, Fault] = {
    f.__name__: f
    for f in (
        drifting_spot,
        image_lag,
        lamp_jump,
        focus_breathing,
        ghost,
        tilted_plate,
        turning_shadow,
        rolling_rows,
        bubbles,
        stage_drift,
        breathing_blur,
    )
}
#: Faults of each capture by itself, with those of `undeclared_faults.UNLISTED`; the others belong to the bench.
EVENTS = frozenset(
    {
        *("drifting_spot", "lamp_jump", "rolling_rows", "bubbles", "stage_drift"),
        *("swapped_frames", "fly", "pressure_wave", "drying_sample", "defocus", "lamp_beat", "banding"),
    }
)
