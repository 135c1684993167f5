"""Values that follow a smooth curve over the wavelengths: retardances, diattenuations, ellipticities.

The prior of such a curve is a Gaussian process (Rasmussen and Williams, Gaussian Processes for Machine Learning, MIT
Press 2006, chapter 4) in the logarithm of the wavelength: neighbours are alike, and what is far apart is independent.
It is fitted as coefficients of its principal curves, which are independent of one another and each of unit variance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.range_of import NEARLY_ZERO
from processing.diagnosis.search.rules import SMOOTH
from processing.effect import Parameter


@dataclass(frozen=True)
class Curve:
    """Parameters that each follow a smooth curve.

    Attributes
    ----------
    wavelengths_nm : (W,), ascending; parameters : P, as they are at one wavelength.
    basis : (W, T) principal curves. The coefficients are stored parameter by parameter: (P T,).
    """

    wavelengths_nm: tuple[float, ...]
    parameters: tuple[Parameter, ...]
    basis: Array = field(compare=False)

    @property
    def coefficients(self) -> tuple[Parameter, ...]:
        """Fitted parameters, one for each coefficient."""
        return tuple(
            Parameter(f"{p.name}_curve_{t}", p.unit, p.lower, p.upper, p.typical)
            for p in self.parameters
            for t in range(self.basis.shape[1])
        )

    def at(self, wavelength_nm: float) -> Array:
        """Matrix (P, P T) that makes the parameters at one wavelength of the coefficients."""
        row = self.basis[self.wavelengths_nm.index(wavelength_nm)]
        return np.asarray(np.kron(np.eye(len(self.parameters)), row))

    def through(self, values: Array) -> Array:
        """Coefficients (P T,) of the curves nearest to values (W, P)."""
        return np.asarray(np.linalg.lstsq(self.basis, values, rcond=None)[0].T.reshape(-1))


def curve(wavelengths_nm: Sequence[float], parameters: tuple[Parameter, ...]) -> Curve | None:
    """Smooth curves over these wavelengths; None where they are so few that each has a value of its own."""
    several = tuple(sorted(set(wavelengths_nm)))
    basis = _principal_curves(several)
    return None if basis.shape[1] >= len(several) else Curve(several, parameters, basis)


def _principal_curves(wavelengths_nm: tuple[float, ...]) -> Array:
    u = np.log(np.asarray(wavelengths_nm)) / SMOOTH
    size, vector = np.linalg.eigh(np.exp(-0.5 * (u[:, None] - u) ** 2))
    keep = size > NEARLY_ZERO * size[-1]
    return np.asarray((vector[:, keep] * np.sqrt(size[keep]))[:, ::-1])
