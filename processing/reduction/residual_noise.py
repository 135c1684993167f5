"""Noise of a capture without a known gain, from the residuals of all its pixels.

The residual of one pixel with few states says little of its noise: with two degrees of freedom, 95 % intervals cover
81 %. All pixels of a camera share one line of variance against signal (EMVA 1288). If they scatter about it by more
than noise does, as those of a wrong model, each keeps a share of its own residual.
"""

import numpy as np

from processing.arrays import Array
from processing.reduction.noise import NoiseModel
from processing.reduction.solvers.base import Solver
from processing.reduction.solvers.plain import MuellerSolver

#: [pixels] Of the image that are looked at: enough for a percent of the variance.
PIXELS = 1 << 14
#: [steps] Of the fit of the line, each with the weights of the last one.
STEPS = 20
#: [of the mean variance] Least variance that the line gives to a pixel.
LEAST = 0.01
#: [of the mean variance] Least floor: a pixel without light has a variance too.
LEAST_FLOOR = 1e-6
#: [of the largest] Eigenvalue of the normal equations from which on both parts of the line are told apart.
TOLD_APART = 1e-9


def noise_of_residual(plain: MuellerSolver, solver: Solver) -> NoiseModel | None:
    """Noise model that explains the residuals of `solver`; None if there are none.

    Parameters
    ----------
    plain : with W of the image's centre, without a noise model.
    solver : that reduces the image, without a noise model; `plain` if W is the same everywhere.
    """
    inversion, reader = plain.inversion, plain.reader
    if not inversion.free > 0:
        return None
    height, width = reader.capture.frame_shape
    squares = np.sum(inversion.null**2, axis=0) / plain.repeats
    without_light = squares.reshape(-1, reader.capture.channels).sum(axis=0)
    scale = len(squares) * inversion.degrees_of_freedom / inversion.free
    # The last row of the variance by the darks is that of the sum of squared residuals.
    by_darks = plain.black[-1]
    columns = []
    for row in range(0, height, max(height * width // PIXELS, 1)):
        frames = reader.read(slice(row, row + 1))
        fit, signal = solver.estimate(frames), np.empty(frames.shape, np.float32)
        gain = reader.signal(frames, slice(None), signal)
        gain = np.ones(frames.shape[1:], np.float32) if gain is None else gain
        square = scale * np.square(fit["residual_rms"], dtype=float) - by_darks @ gain**2
        light = squares @ (signal * gain).reshape(len(squares), -1)
        # A pixel without any residual was masked before it came here.
        is_measured = (fit["pixel_flags"] == 0) & (fit["residual_rms"] > 0)
        columns.append(np.stack([square, light, without_light @ gain**2])[:, is_measured])
    square, *parts = np.concatenate(columns, axis=1)
    if not square.size or not square.max() > 0:
        return None
    slope, floor, expected = _line(square, np.stack(parts))
    floor = max(floor, LEAST_FLOOR * float(expected.mean() / parts[1].mean()))
    by_noise = 2 / inversion.free
    more = max(float(np.var(square / expected)) - by_noise, 0.0)
    source = f"estimated from the residuals of {square.size} pixels, because the gain is not known"
    return NoiseModel(slope, floor, 0.0, source, residual_share=more / (more + by_noise))


def _line(square: Array, design: Array) -> tuple[float, float, Array]:
    """Slope (counts) and floor (counts^2) of the variance, neither negative, and the squares (P,) that they give.

    Parameters
    ----------
    square : (P,) sums of squared residuals, counts^2.
    design : (2, P) those that a slope and a floor of one give.
    """
    expected, line = np.full(square.shape, square.mean()), np.zeros(2)
    for _ in range(STEPS):
        # The error of a square is proportional to it.
        weighted = design / expected**2
        normal, right = weighted @ design.T, weighted @ square
        line = np.linalg.lstsq(normal, right, rcond=TOLD_APART)[0]
        if line.min() < 0:
            line = np.where(np.arange(2) == np.argmax(line), np.maximum(right, 0) / np.diag(normal), 0.0)
        given = line @ np.maximum(design, 0)
        expected = np.maximum(given, LEAST * given.mean())
    return float(line[0]), float(line[1]), expected
