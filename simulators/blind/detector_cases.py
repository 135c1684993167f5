"""Captures whose detector differs from the declared one, or with bad frames or pixels; the optics are right.

`diagnose` may say that the noise is not as declared, and leave frames and pixels out; any name of an optical cause is
wrong.
"""

import numpy as np

from processing.arrays import Array
from simulators.blind.undeclared_captures import TrueBench
from simulators.blind.undeclared_faults import Fault, Truth


def read_noise_doubled(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Twice the read noise that is declared."""
    bench.declared["read_noise_e"] = bench.read_noise
    bench.read_noise *= 2
    return Truth("read_noise_doubled")


def row_noise(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Every row of every frame has another offset, 3 electrons rms."""
    bench.noise.append(lambda e, r: e + 3.0 * r.standard_normal((*e.shape[:2], 1)))
    return Truth("row_noise")


def black_jitter(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The black level of every frame is off by 3 electrons rms."""
    bench.noise.append(lambda e, r: e + 3.0 * r.standard_normal((e.shape[0], 1, 1)))
    return Truth("black_jitter")


def uneven_steps(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The converter's steps are uneven: a pattern of 64 steps that is 4 counts off at most, the same everywhere."""
    offsets = np.cumsum(random.standard_normal(64))
    offsets -= np.linspace(offsets[0], offsets[-1], 64)
    offsets *= 4.0 / np.abs(offsets).max()
    bench.stored.append(lambda counts: counts + offsets[counts.astype(int) // 16 % 64])
    return Truth("uneven_steps")


def gain_misstated(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The gain is declared 20 % too large or too small."""
    factor = float(random.choice([1.2, 1 / 1.2]))
    bench.declared["gain_e_per_count"] = bench.gain * factor
    return Truth("gain_misstated", "", {"declared_over_true": factor})


def gain_not_stated(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Nothing is declared of gain, read noise and full well."""
    bench.declared.update(gain_e_per_count=None, read_noise_e=None, full_well_e=None)
    return Truth("gain_not_stated")


def resampled(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Images were moved by a part of a pixel before they were stored: the noise of neighbours is correlated."""
    x, y = random.uniform(0.3, 0.7, 2)

    def move(counts: Array) -> Array:
        right = np.concatenate([counts[..., 1:], counts[..., -1:]], axis=-1)
        counts = (1 - x) * counts + x * right
        down = np.concatenate([counts[:, 1:], counts[:, -1:]], axis=1)
        return np.asarray((1 - y) * counts + y * down)

    bench.stored.append(move)
    return Truth("resampled")


def bad_frame(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """One frame belongs to nothing: the shutter was half closed, or the axis stood elsewhere."""
    bad, closed = int(random.integers(states)), bool(random.random() < 0.5)
    if closed:
        level = random.uniform(0.2, 0.8)
        bench.level.append(lambda k, a: level if k == bad else 1.0)
    else:
        offset = np.deg2rad(random.uniform(8, 60))
        bench.angles.append(lambda k, a: a | {"psg": a["psg"] + offset * (k == bad)})
    return Truth("bad_frame", "", {"state": float(bad)})


def cosmic_rays(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Three tracks a frame, one to four pixels long, of 1000 to 10 000 electrons a pixel."""

    def strike(e: Array, r: np.random.Generator) -> Array:
        e = e.copy()
        rows, columns = e.shape[1:]
        for frame in e:
            for _ in range(3):
                y, x, right = int(r.integers(rows)), int(r.integers(columns)), int(r.integers(2))
                for step in range(int(r.integers(1, 5))):
                    frame[min(y + step, rows - 1), min(x + right * step, columns - 1)] += r.uniform(1e3, 1e4)
        return e

    bench.noise.append(strike)
    return Truth("cosmic_rays")


def bad_pixels(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """Three pixels of a thousand are stuck, hot and restless, or answer half."""
    kind = random.choice(4, size=(bench.rows, bench.columns), p=[0.997, 0.001, 0.001, 0.001])

    def spoil(e: Array, r: np.random.Generator) -> Array:
        hot = e + 4000.0 * r.uniform(0.5, 1.5, e.shape)
        return np.asarray(np.select([kind == 1, kind == 2, kind == 3], [0 * e + 50.0, hot, e / 2], e))

    bench.noise.append(spoil)
    return Truth("bad_pixels")


DETECTOR: dict[str, Fault] = {
    f.__name__: f
    for f in (
        read_noise_doubled,
        row_noise,
        black_jitter,
        uneven_steps,
        gain_misstated,
        gain_not_stated,
        resampled,
        bad_frame,
        cosmic_rays,
        bad_pixels,
    )
}
