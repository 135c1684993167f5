"""Contributions to the deviations: noise, registration, the constants of the material, and the remainder.

Contributions add as squares where they are independent. The noise is what the error bars of the captures predict; each
other one is by how much the square of the deviation falls when its cause is taken away: the sphere found in the images
in place of the file's, the bench's own material in place of Table I, which only a simulation knows.
"""

from dataclasses import dataclass

import numpy as np
from paper_study.figures import NOISE
from paper_study.process import SphereStudy

from processing.campaign.run import CampaignResult

QUANTITIES = tuple(NOISE)


@dataclass(frozen=True)
class Budget:
    """Mean squares over the arm angles of one figure of merit at one wavelength; a negative one made it better.

    `remainder` is the share with the true sphere and material and without noise: for xi0, the scene is not triply
    degenerate.
    """

    total: float
    noise: float
    registration: float
    material: float
    remainder: float


def budget(study: SphereStudy, nm: float, quantity: str) -> Budget:
    """The budget of a figure of merit of `processing.campaign.run.Row`."""
    runs = (study.as_told, study.registered, study.true_material)
    total, registered, true_material = (_mean_square(run, nm, quantity) for run in runs)
    noises = [_mean_square(run, nm, NOISE[quantity]) for run in runs]
    # The noise differs a little between the runs: other pixels count.
    nominal, aligned, ideal = (a - b for a, b in zip((total, registered, true_material), noises, strict=True))
    return Budget(total, noises[0], nominal - aligned, aligned - ideal, ideal)


def signed_root(square: float) -> float:
    """Root of a mean square; minus that of its size where it is negative."""
    return float(np.sign(square) * np.sqrt(abs(square)))


def _mean_square(result: CampaignResult, nm: float, name: str) -> float:
    values = [getattr(row, name) for row in result.rows if row.wavelength_nm == nm]
    return float(np.nanmean(np.square(values)))
