"""psi and |D| of the dominant process and xi0 by a model of the reflectance, and what a correction does to xi0."""

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.decision import PredictedChange, chance_checks
from processing.diagnosis.search.fit import Solution
from processing.diagnosis.search.range_of import rank_of
from processing.diagnosis.search.result import Check
from processing.diagnosis.search.space import Space
from processing.diagnosis.surface.problem import SurfacePixels, SurfaceProblem
from processing.polarization.cloude import xi0_and_dominant
from processing.polarization.image_difference import linear_diattenuation, magnitude, orientation_difference, rmsd
from processing.section import Section

#: [of its noise] Polarized light of a pixel from which on its xi0 is shown.
SHOWS_XI0 = 20.0


class SurfaceQuantities(Section):
    """Quantities of one capture by the model.

    `psi_deg` and `magnitude_percent` are root mean square differences between the modelled and the measured dominant
    process (a full Mueller capture only), the `noise` ones what they would be if the model were right: its intensities
    with noise drawn. `xi0` is the median, `unphysical` the part of the pixels whose xi0 is outside [1/4, 1].
    """

    psi_deg: float | None
    magnitude_percent: float | None
    psi_noise_deg: float | None
    magnitude_noise_percent: float | None
    xi0: float
    unphysical: float


def quantities(problem: SurfaceProblem, k: int, space: Space, values: Array) -> tuple[SurfaceQuantities, Array]:
    """Quantities of a capture by the model with these values, and xi0 of its pixels (P,)."""
    pixels, data = problem.pixels(k, space, values), problem.captures[k]
    xi0 = _xi0(pixels)
    good = xi0[np.isfinite(xi0)]
    ideal = data.y - pixels.residual * problem.sigma[k]
    drawn = np.random.default_rng(0).normal(ideal, problem.sigma[k])
    measured, expected = (dominant_errors(problem, k, space, values, y=y) for y in (data.y, drawn))
    result = SurfaceQuantities(
        psi_deg=None if measured is None else rmsd(measured[0]),
        magnitude_percent=None if measured is None else rmsd(measured[1]),
        psi_noise_deg=None if expected is None else rmsd(expected[0]),
        magnitude_noise_percent=None if expected is None else rmsd(expected[1]),
        xi0=float(np.median(good)) if good.size else float("nan"),
        unphysical=float(np.mean((good < 0.25) | (good > 1))) if good.size else float("nan"),
    )
    return result, xi0


def _xi0(pixels: SurfacePixels) -> Array:
    """xi0 (P,) of the pixels of a capture; NaN where it is noise."""
    total = pixels.alpha_0 + pixels.alpha_id
    with np.errstate(divide="ignore", invalid="ignore"):
        xi0 = (pixels.alpha_0 + pixels.alpha_id / 4) / total
        # Where the model modulates little, xi0 is noise.
        xi0[pixels.strength * total < SHOWS_XI0] = np.nan
    return np.asarray(xi0, dtype=float)


def dominant_errors(
    problem: SurfaceProblem, k: int, space: Space, values: Array, *, y: Array
) -> tuple[Array, Array] | None:
    """Modelled less measured psi (degrees) and |D| (percent) of each pixel (P,); None if W has not rank 16."""
    optics, surface = problem.changes(k, space, values)
    w = problem.rows_of(k, optics)
    if rank_of(w) < 16:
        return None
    _, m0 = xi0_and_dominant((y @ np.linalg.pinv(w).T).reshape(-1, 4, 4))
    measured, modelled = (linear_diattenuation(m) for m in (m0, problem.captures[k].view.dominant(surface)))
    psi = np.rad2deg(orientation_difference(modelled, measured))
    return np.asarray(psi, dtype=float), np.asarray(100 * (magnitude(modelled) - magnitude(measured)), dtype=float)


def chances(problem: SurfaceProblem, solved: Solution, covariance: Array) -> tuple[Check, ...]:
    """Change of xi0 by the correction, whose values have a covariance (K, K); none where no pixel shows xi0."""
    if not solved.effects:
        return ()
    change = change_of_xi0(problem, solved, covariance)
    return () if change is None else chance_checks("xi0", change)


def change_of_xi0(problem: SurfaceProblem, solved: Solution, covariance: Array) -> PredictedChange | None:
    """The change of xi0 and its error, which is that at both ends of every principal axis of the values.

    Slopes at what was found do not tell it: the model is far from linear, and values have bounds.
    """
    space, values = solved.space, solved.fit.values
    xi0 = _all_xi0(problem, space, values)
    change = xi0 - _all_xi0(problem, space, np.zeros(space.size))
    if not np.isfinite(change).any():
        return None
    size = float(np.sqrt(_mean(change**2)))
    along, total = 0.0, 0.0
    lower, upper = space.joined("lower"), space.joined("upper")
    variance, axes = np.linalg.eigh(covariance)
    for axis in (np.sqrt(np.maximum(variance, 0.0)) * axes).T:
        ends = [_all_xi0(problem, space, np.clip(values + sign * axis, lower, upper)) - xi0 for sign in (1, -1)]
        total += sum(_mean(end**2) for end in ends) / 2
        along += sum(_mean(end * change) ** 2 for end in ends) / 2 / max(size, 1e-300) ** 2
    return PredictedChange(float(np.hypot(size, np.sqrt(total))), float(np.sqrt(total)), size, size, float(along**0.5))


def _all_xi0(problem: SurfaceProblem, space: Space, values: Array) -> Array:
    return np.concatenate([_xi0(problem.pixels(k, space, values)) for k in range(len(problem.captures))])


def _mean(x: Array) -> float:
    """Over the pixels that show xi0."""
    shown = x[np.isfinite(x)]
    return float(shown.mean()) if shown.size else 0.0
