"""Demosaicing methods against known truth: PSNR by channel, DoLP, AoLP, at edges and in smooth regions.

Run: OPENBLAS_NUM_THREADS=1 .venv/bin/python benchmarks/mosaic_quality.py [--size 512] [--seed 1]
The scenes are made here. No method was tuned on the seeds of docs/studies/mosaic.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.mosaic.methods import METHODS, demosaic

LAYOUT = MosaicLayout.of((("90", "45"), ("135", "0")), ("0", "45", "90", "135"))
ANGLES = np.deg2rad([0.0, 45.0, 90.0, 135.0])
FULL = 4095.0
Scene = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


def fractal(rng: np.random.Generator, size: int) -> Scene:
    """1/f^1.6 amplitude spectra: intensity, degree and angle vary together at all scales, no sharp edges."""

    def noise(power: float) -> NDArray[np.float64]:
        f = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
        f[0, 0] = 1
        field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) / f**power).real
        return (field - field.min()) / np.ptp(field)

    return 0.1 + 0.8 * noise(1.6), 0.05 + 0.6 * noise(1.9), np.pi * noise(1.9)


def patches(rng: np.random.Generator, size: int) -> Scene:
    """Overlapping discs and polygons, each with its own intensity, degree and angle, seen through a little blur."""
    s0, dolp, aolp = (np.full((size, size), v) for v in (0.4, 0.2, 0.5))
    for _ in range(90):
        stencil = np.zeros((size, size), np.uint8)
        if rng.random() < 0.5:
            centre = tuple(int(v) for v in rng.integers(0, size, 2))
            cv2.circle(stencil, centre, int(rng.integers(size // 40, size // 8)), 1, -1)
        else:
            points = rng.integers(0, size, 2) + rng.integers(-size // 8, size // 8, (4, 2))
            cv2.fillConvexPoly(stencil, cv2.convexHull(points.astype(np.int32)), 1)
        for image, value in ((s0, rng.uniform(0.1, 0.9)), (dolp, rng.uniform(0, 0.7)), (aolp, rng.uniform(0, np.pi))):
            image[stencil > 0] = value
    return s0, dolp, aolp


def star(rng: np.random.Generator, size: int) -> Scene:
    """Siemens star: spokes in intensity and in degree, the angle running around, up to the highest frequencies."""
    y, x = np.indices((size, size)) - (size - 1) / 2
    turn = np.arctan2(y, x)
    shift = rng.uniform(0, np.pi)
    return (
        0.5 + 0.35 * np.sign(np.cos(36 * turn)),
        0.35 + 0.25 * np.sign(np.cos(18 * turn)),
        np.mod(turn + shift, np.pi),
    )


SCENES: dict[str, Callable[[np.random.Generator, int], Scene]] = {"fractal": fractal, "patches": patches, "star": star}


def channels(scene: Scene) -> NDArray[np.float64]:
    """Intensities (4, rows, columns) in counts behind the four analyzers, blurred by the lens (0.6 pixels)."""
    s0, dolp, aolp = scene
    full = np.stack([0.5 * s0 * (1 + dolp * np.cos(2 * (aolp - t))) for t in ANGLES]) * FULL
    return np.stack([cv2.GaussianBlur(c, (0, 0), 0.6) for c in full])


def stokes(c: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """DoLP and AoLP (radians)."""
    s1, s2 = c[0] - c[2], c[1] - c[3]
    return np.hypot(s1, s2) / np.maximum(c.sum(axis=0) / 2, 1.0), 0.5 * np.arctan2(s2, s1)


def measure(truth: NDArray[np.floating], found: NDArray[np.floating]) -> dict[str, float]:
    """Figures of merit inside a border of 16 pixels."""
    inner = np.s_[..., 16:-16, 16:-16]
    t, f = truth[inner], found[inner]
    error = np.mean((t - f) ** 2, axis=0)
    gradient = np.hypot(cv2.Sobel(t.sum(axis=0), cv2.CV_64F, 1, 0), cv2.Sobel(t.sum(axis=0), cv2.CV_64F, 0, 1))
    edge = gradient > np.quantile(gradient, 0.85)
    (dt, at), (df, af) = stokes(t), stokes(f)
    polarized = dt > 0.05
    wrapped = (af - at + np.pi / 2) % np.pi - np.pi / 2
    return {
        "psnr": _psnr(error.mean()),
        "psnr_edges": _psnr(error[edge].mean()),
        "psnr_smooth": _psnr(error[~edge].mean()),
        "dolp_percent": 100 * float(np.sqrt(np.mean((df - dt) ** 2))),
        "aolp_deg": float(np.rad2deg(np.mean(np.abs(wrapped[polarized])))),
    }


def _psnr(mse: float) -> float:
    return float(10 * np.log10(FULL**2 / max(mse, 1e-12)))


def compare(size: int, seed: int, noise: float) -> dict[tuple[str, str], dict[str, float]]:
    """All methods on all scenes; `noise` is a part of full scale."""
    out = {}
    for name, make in SCENES.items():
        rng = np.random.default_rng(seed)
        truth = channels(make(rng, size))
        frame = np.empty((size, size))
        for k, (r, c) in enumerate(LAYOUT.offsets):
            frame[r::2, c::2] = truth[k, r::2, c::2]
        frame = np.rint(frame + rng.normal(0, noise * FULL, frame.shape)) if noise else frame
        for method in METHODS:
            found = demosaic(frame.astype(np.float32), LAYOUT, method).astype(float)
            if found.shape[1] < size:
                found = np.repeat(np.repeat(found, 2, axis=1), 2, axis=2)
            out[name, method] = measure(truth, found)
    return out


def main() -> None:
    """Print the tables of docs/studies/mosaic.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for noise in (0.0, 0.01):
        found = compare(arguments.size, arguments.seed, noise)
        print(
            f"\nnoise {noise:.0%} of full scale; PSNR all / edges / smooth in dB, DoLP rms in %, AoLP mean in degrees"
        )
        print("| method | " + " | ".join(SCENES) + " |")
        print("|---|" + "---|" * len(SCENES))
        for method in METHODS:
            cells = []
            for scene in SCENES:
                f = found[scene, method]
                cells.append(
                    f"{f['psnr']:.1f} / {f['psnr_edges']:.1f} / {f['psnr_smooth']:.1f}, "
                    f"{f['dolp_percent']:.1f} %, {f['aolp_deg']:.1f}"
                )
            print(f"| {method} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
