"""Constants n, alpha and albedo of a sum of two processes from Mueller elements or Stokes vectors.

Least squares on the values of each pixel, divided by the noise. The brightness of each pixel is projected out: the
light may be uneven, and no white reference is necessary.
"""

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from processing.arrays import Array
from processing.geometry.frames import ScatteringGeometry
from processing.reflectance.fitted_constants import MaterialFit, Ranges, evenly, result_of, search, unexplained_square
from processing.reflectance.rough_plastic import processes

PLASTIC = Ranges(
    kind="rough_plastic",
    names=("n", "alpha", "albedo"),
    lower=np.array([1.01, 0.02, 0.0]),
    upper=np.array([4.0, 1.0, 1.0]),
    starts=((1.5, 0.3, 0.3), (1.3, 0.15, 0.05), (1.8, 0.6, 0.8)),
    sizes=(0.1, 0.1, 0.1),
    small=(0.0, 0.0, 0.02),
)


def fit_plastic(
    geometry: ScatteringGeometry,
    values: ArrayLike,
    rows: ArrayLike,
    covariance: ArrayLike,
    *,
    max_pixels: int = 5000,
    moved: Sequence[tuple[ArrayLike, ArrayLike]] = (),
) -> MaterialFit:
    """Constants of a rough plastic from values that are linear in M; all as in `material_fit.fit_values`."""
    x, c, r = (np.asarray(a, dtype=float) for a in (values, covariance, rows))
    keep = evenly(np.isfinite(x).all(axis=0) & np.isfinite(c).all(axis=(1, 2)), max_pixels)
    points = geometry[keep]
    # The ridge is for values without noise.
    c = c[keep] + 1e-9 * np.trace(c[keep], axis1=1, axis2=2)[:, None, None] * np.eye(len(x))
    whiten = np.linalg.inv(np.linalg.cholesky(c))

    def residual(q: Array, data: Array, back: Array) -> Array:
        surface, volume = processes(points, float(q[0]), float(q[1]))
        modelled = np.einsum("nki,ni->nk", back, (surface + q[2] * volume).reshape(-1, 16))
        square = np.maximum(np.sum(modelled**2, axis=1, keepdims=True), 1e-300)
        return np.asarray(data - modelled * np.sum(modelled * data, axis=1, keepdims=True) / square)

    each = []
    for signal, leads in [(x, r), *((np.asarray(v, dtype=float), np.asarray(w, dtype=float)) for v, w in moved)]:
        each.append((np.einsum("nij,jn->ni", whiten, signal[:, keep]), whiten @ leads))
    constants, jacobian = search(partial(residual, data=each[0][0], back=each[0][1]), PLASTIC)
    off = [search(partial(residual, data=v, back=w), PLASTIC, constants)[0] - constants for v, w in each[1:]]
    base, *changed = (residual(constants, *data) for data in each)
    square = unexplained_square(base, [change - base for change in changed])
    return result_of(
        constants,
        jacobian.T @ jacobian,
        np.einsum("nkp,nk->np", jacobian.reshape(*base.shape, 3), base),
        square,
        free=base.size - len(base) - 3,
        method="sum of two processes",
        off=np.array(off).reshape(-1, 3),
        of=PLASTIC,
    )
