"""M of a plate from the ratio of two channels alone: a reference that shares no code with the project's fits."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from processing.polarization import mueller

Array = NDArray[np.float64]


def ratio_of_channels(air: Array, plate: Array) -> Array:
    """M/m00 of a plate from (left - right)/(left + right) alone, tables (N, 3) of angle in degrees, left and right.

    A train of its own: two retarders, elliptical light, and azimuth, extinction and gain of the channels.
    """
    random = np.random.default_rng(0)

    def rows(x: Array, theta_deg: Array) -> Array:
        t = np.deg2rad(theta_deg)
        light = mueller.retarder(np.deg2rad(45.0), x[9]) @ mueller.polarizer(0.0, 0.0)[:, :1]
        g = (mueller.retarder(t + x[0], x[1]) @ light)[..., 0]
        plate = mueller.retarder(5 * t + x[2], x[3])
        a = np.stack(
            [mueller.polarizer(x[4], x[6])[0] @ plate, x[8] * mueller.polarizer(x[5], x[7])[0] @ plate], axis=1
        )
        return np.asarray((a[..., :, None] * g[:, None, None, :]).reshape(len(t), 2, 16))

    def misfit(x: Array) -> Array:
        light = rows(x, air[:, 0]) @ np.eye(4).reshape(16)
        return np.asarray((light @ [1, -1]) / light.sum(axis=1) - (air[:, 1:] @ [1, -1]) / air[:, 1:].sum(axis=1))

    fits = []
    for k in range(24):
        azimuths = random.uniform(-np.pi / 2, np.pi / 2, 2)
        crossed = np.pi / 2 * (k % 2)
        start = [azimuths[0], 1.57, azimuths[1], 1.57, crossed, crossed + np.pi / 2, 0.002, 0.002, 1.0, 0.0]
        low = [-9, 0.8, -9, 0.8, -9, -9, 0, 0, 0.5, -0.3]
        fits.append(least_squares(misfit, start, bounds=(low, [9, 2.4, 9, 2.4, 9, 9, 0.1, 0.1, 2.0, 0.3])))
    w = rows(min(fits, key=lambda fit: float(fit.cost)).x, plate[:, 0])
    # left w_right m = right w_left m in every state, with the weight of its light.
    across, weight = plate[:, 1:2] * w[:, 1] - plate[:, 2:] * w[:, 0], np.ones(len(w))
    for _ in range(5):
        m = np.linalg.svd(across / weight[:, None])[2][-1]
        weight = w.sum(axis=1) @ m / m[0]
    return np.asarray((m / m[0]).reshape(4, 4))
