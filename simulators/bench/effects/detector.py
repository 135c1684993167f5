"""Detectors that answer crookedly: response, fixed pattern, black level."""

import zlib
from typing import Literal

import numpy as np
from pydantic import Field

from processing.arrays import Image
from simulators.bench.effects.base import BenchEffect, Shot


class Nonlinearity(BenchEffect):
    """The response bends: electrons lose the fraction `at_full_scale` at `full_scale_e`, in proportion below."""

    kind: Literal["nonlinearity"] = "nonlinearity"
    at_full_scale: float = Field(default=0.0, description="part of the electrons that is lost at full scale")
    full_scale_e: float = Field(default=10_000.0, description="electrons at full scale")

    def detector(self, electrons: Image, shot: Shot) -> Image:
        return np.asarray(electrons * (1 - self.at_full_scale * electrons / self.full_scale_e), dtype=np.float32)


class PixelResponse(BenchEffect):
    """Fixed pattern: each pixel's response differs, relative standard deviation `sigma`, the same in every frame."""

    kind: Literal["pixel_response"] = "pixel_response"
    sigma: float = Field(default=0.0, description="standard deviation, relative")

    def detector(self, electrons: Image, shot: Shot) -> Image:
        pattern = np.random.default_rng([shot.seed, zlib.crc32(b"pixel response")])
        return np.asarray(electrons * (1 + self.sigma * pattern.standard_normal(electrons.shape, dtype=np.float32)))


class BlackDrift(BenchEffect):
    """The black level moves by electrons an hour."""

    kind: Literal["black_drift"] = "black_drift"
    e_per_hour: float = Field(default=0.0, description="electrons an hour")

    def detector(self, electrons: Image, shot: Shot) -> Image:
        return np.asarray(electrons + np.float32(self.e_per_hour * shot.time_s / 3600))


class BlackOffset(BenchEffect):
    """The black level is `electrons` above what the header says."""

    kind: Literal["black_offset"] = "black_offset"
    electrons: float = Field(default=0.0, description="black level above what the header says, electrons")

    def detector(self, electrons: Image, shot: Shot) -> Image:
        return np.asarray(electrons + np.float32(self.electrons))


class ToneCurveFault(BenchEffect):
    """The camera stores a power of the light: its contrast setting is not 1."""

    kind: Literal["tone_curve"] = "tone_curve"
    gamma: float = Field(default=1.0, description="the camera stores light to the power 1 / gamma")
    full_scale_e: float = Field(default=10_000.0, description="electrons at full scale")

    def detector(self, electrons: Image, shot: Shot) -> Image:
        share = np.maximum(electrons, 0) / self.full_scale_e
        return np.asarray(self.full_scale_e * share ** (1 / self.gamma), dtype=np.float32)
