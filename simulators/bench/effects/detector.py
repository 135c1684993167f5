"""Detectors that answer crookedly: response, fixed pattern, black level."""

from __future__ import annotations

import zlib
from typing import Literal

import numpy as np

from processing.arrays import Image
from simulators.bench.effects.base import BenchEffect, Shot


class Nonlinearity(BenchEffect):
    """The response bends: electrons lose the fraction `at_full_scale` at `full_scale_e`, in proportion below."""

    kind: Literal["nonlinearity"] = "nonlinearity"
    at_full_scale: float = 0.0
    full_scale_e: float = 10_000.0

    def detector(self, electrons: Image, shot: Shot) -> Image:
        return np.asarray(electrons * (1 - self.at_full_scale * electrons / self.full_scale_e), dtype=np.float32)


class PixelResponse(BenchEffect):
    """Fixed pattern: each pixel's response differs, relative standard deviation `sigma`, the same in every frame."""

    kind: Literal["pixel_response"] = "pixel_response"
    sigma: float = 0.0

    def detector(self, electrons: Image, shot: Shot) -> Image:
        pattern = np.random.default_rng([shot.seed, zlib.crc32(b"pixel response")])
        return np.asarray(electrons * (1 + self.sigma * pattern.standard_normal(electrons.shape, dtype=np.float32)))


class BlackDrift(BenchEffect):
    """The black level moves by electrons an hour."""

    kind: Literal["black_drift"] = "black_drift"
    e_per_hour: float = 0.0

    def detector(self, electrons: Image, shot: Shot) -> Image:
        return np.asarray(electrons + np.float32(self.e_per_hour * shot.time_s / 3600))


class BlackOffset(BenchEffect):
    """The black level is `electrons` above what the header says."""

    kind: Literal["black_offset"] = "black_offset"
    electrons: float = 0.0

    def detector(self, electrons: Image, shot: Shot) -> Image:
        return np.asarray(electrons + np.float32(self.electrons))


class ToneCurve(BenchEffect):
    """The camera stores a power of the light: its contrast setting is not 1."""

    kind: Literal["tone_curve"] = "tone_curve"
    gamma: float = 1.0
    full_scale_e: float = 10_000.0

    def detector(self, electrons: Image, shot: Shot) -> Image:
        share = np.maximum(electrons, 0) / self.full_scale_e
        return np.asarray(self.full_scale_e * share ** (1 / self.gamma), dtype=np.float32)
