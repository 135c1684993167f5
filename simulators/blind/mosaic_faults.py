"""Faults that only a polarization camera can have: of its channels, and of neighbouring pixels."""

import numpy as np

from processing.arrays import Array
from simulators.blind.undeclared_captures import TrueBench
from simulators.blind.undeclared_faults import SizedFault, Sizes, Truth, draw_size


def channel_gain(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.003, 0.05)) -> Truth:
    bench.channel_gain = np.append(1.0, 1 + draw_size(random, *sizes) * random.standard_normal(3))
    names = ("channel_45", "channel_90", "channel_135")
    return Truth("channel_gain", "", dict(zip(names, (bench.channel_gain[1:] - 1).tolist(), strict=True)))


def channel_azimuth(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.2, 2.0)) -> Truth:
    degrees = draw_size(random, *sizes) * random.standard_normal(4)
    bench.channel_azimuth = np.deg2rad(degrees)
    return Truth("channel_azimuth")


def channel_extinction(
    bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.003, 0.04)
) -> Truth:
    bench.channel_extinction = draw_size(random, *sizes) * random.uniform(0.2, 1.8, 4)
    return Truth("channel_extinction")


def pixel_crosstalk(bench: TrueBench, random: np.random.Generator, states: int, sizes: Sizes = (0.01, 0.1)) -> Truth:
    size = draw_size(random, *sizes)

    def spread(k: int, e: Array) -> Array:
        p = np.pad(e, 1, mode="reflect")
        around = (p[:-2, 1:-1] + p[2:, 1:-1] + p[1:-1, :-2] + p[1:-1, 2:]) / 4
        return (1 - size) * e + size * around

    bench.light.append(spread)
    return Truth("pixel_crosstalk", "", {"fraction": size})


MOSAIC: dict[str, SizedFault] = {
    "channel_gain": channel_gain,
    "channel_azimuth": channel_azimuth,
    "channel_extinction": channel_extinction,
    "pixel_crosstalk": pixel_crosstalk,
}
