"""Noise of a capture whose gain is not known, from what the fits of all its pixels leave over.

One pixel's residual of few states says little of its own noise: with two degrees of freedom, an interval of two such
errors covers 81 %. All pixels together have the camera's line. Where they scatter about it by more than noise does, as
those of a wrong model, each keeps that share of its own residual.
"""

import numpy as np

from processing.arrays import Array
from processing.reduction.noise import NoiseModel
from processing.reduction.solvers.base import Solver
from processing.reduction.solvers.plain import MuellerSolver

#: About so many pixels are enough.
PIXELS = 1 << 14
ROUNDS = 20
SOURCE = "estimated from the residuals of {} pixels, because the gain is not known"


def noise_of_residual(plain: MuellerSolver, solver: Solver) -> NoiseModel | None:
    """The line of variance that makes the residuals of `solver`, and the share of each pixel's own residual.

    None where no residual is left over: as many unknowns as intensities, or no sound pixel.

    Parameters
    ----------
    plain : with W of the centre, without a noise model; also `solver` where W is the same everywhere.
    """
    inversion, reader = plain.inversion, plain.reader
    if not inversion.free > 0:
        return None
    height, width = reader.capture.frame_shape
    squares = np.sum(inversion.null**2, axis=0) / plain.repeats
    floor = squares.reshape(-1, reader.capture.channels).sum(axis=0)
    scale = len(squares) * inversion.degrees_of_freedom / inversion.free
    found = []
    for row in range(0, height, max(height * width // PIXELS, 1)):
        frames = reader.read(slice(row, row + 1))
        fit, signal = solver.estimate(frames), np.empty(frames.shape, np.float32)
        gain = reader.signal(frames, slice(None), signal)
        gain = np.ones(frames.shape[1:], np.float32) if gain is None else gain
        square = scale * np.square(fit["residual_rms"], dtype=float) - plain.black[16] @ gain**2
        light = squares @ (signal * gain).reshape(len(squares), -1)
        found.append(np.stack([square, light, floor @ gain**2])[:, fit["pixel_flags"] == 0])
    square, *parts = np.concatenate(found, axis=1)
    design = np.stack(parts)
    if not square.size or not square.max() > 0:
        return None
    slope, read = _line(square, design)
    ratio = square / (slope * np.maximum(design[0], 0) + read * design[1])
    by_noise = 2 / inversion.free
    more = max(float(np.var(ratio)) - by_noise, 0.0)
    return NoiseModel(slope, read, 0.0, SOURCE.format(square.size), own=more / (more + by_noise))


def _line(square: Array, design: Array) -> tuple[float, float]:
    """Slope and floor, neither negative, that explain squares (pixels,) by `design` (2, pixels), each in its error."""
    expected = np.full(square.shape, square.mean())
    line = np.zeros(2)
    for _ in range(ROUNDS):
        weighted = design / expected**2
        normal, right = weighted @ design.T, weighted @ square
        alone = np.maximum(right, 0) / np.diag(normal)
        line = np.linalg.lstsq(normal, right, rcond=1e-9)[0]
        if line.min() < 0:
            line = np.where(np.arange(2) == np.argmax(line), alone, 0.0)
        fitted = line @ np.maximum(design, 0)
        expected = np.maximum(fitted, 0.01 * fitted.mean())
    return float(line[0]), float(line[1])
