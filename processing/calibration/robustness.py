"""Effect of undeclared errors of a bench on the Mueller matrix that a table of states gives."""

from collections.abc import Mapping

import numpy as np

from processing.arrays import Array
from processing.calibration.free_angles import retardance_deg, turning_retarders, with_retardances
from processing.instrument.determined_basis import determined_basis
from processing.instrument.model import InstrumentModel

#: The errors that `diagnose` finds most often, at the size of a bench that was set up with care.
ERRORS = {
    "azimuth": "every axis off its zero by 0.1 degree",
    "retardance": "every turning retarder off by 1 degree",
    "drift": "source that drifts by 1 % over the capture",
}
AZIMUTH_DEG, RETARDANCE_DEG, DRIFT = 0.1, 1.0, 0.01
#: Rms of m_ij / m00 of the sample.
POLARIZATION = 0.3
STEP = 1e-3


def errors_of_table(model: InstrumentModel, angles_deg: Mapping[str, Array]) -> dict[str, float]:
    """Rms error of m_ij / m00 by each kind of `ERRORS`, over samples with independent elements of that rms.

    An error p of W makes M wrong by pinv(W) dW/dp M; several axes or plates add in squares.
    """
    basis = determined_basis(model)
    w = model.rows(angles_deg).reshape(-1, 16)
    inverse = basis @ np.linalg.pinv(w @ basis)
    prior = np.concatenate([[1.0], np.full(15, POLARIZATION)])

    def rms(change: Array) -> float:
        wrong = inverse @ (change.reshape(-1, 16) * prior)
        # The throughput alone is no error of m_ij / m00.
        wrong = wrong - np.outer(np.eye(16)[0], wrong[0])
        return float(np.sqrt(np.sum(wrong**2) / 15))

    def azimuth(axis: str) -> Array:
        plus, minus = (model.rows({**angles_deg, axis: angles_deg[axis] + s * STEP}) for s in (1, -1))
        return (plus - minus) * (AZIMUTH_DEG / (2 * STEP))

    def retardance(name: str) -> Array:
        start = retardance_deg(model, name)
        plus, minus = (with_retardances(model, {name: start + s * STEP}).rows(angles_deg) for s in (1, -1))
        return (plus - minus) * (RETARDANCE_DEG / (2 * STEP))

    n = len(next(iter(angles_deg.values())))
    drift = np.linspace(-0.5, 0.5, n)[:, None] * DRIFT * w.reshape(n, -1)
    return {
        "azimuth": float(np.hypot.reduce([rms(azimuth(axis)) for axis in model.axes])),
        "retardance": float(np.hypot.reduce([rms(retardance(name)) for name in turning_retarders(model)] or [0.0])),
        "drift": rms(drift),
    }
