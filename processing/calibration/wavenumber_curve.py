"""Values of optics that follow a smooth curve over the wavelengths: a polynomial in the wavenumber.

The retardance of a plate is 2 pi d times its birefringence over the wavelength, and the birefringence of a crystal far
from its absorption changes little and smoothly: a straight line in 1/wavelength is most of a single plate, a parabola
an achromatic one. A constant is one coefficient.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from processing.calibration.known_sample import CalibrationError


@dataclass(frozen=True)
class WavenumberCurve:
    """Curves with some coefficients over a range of wavelengths.

    Attributes
    ----------
    shortest_nm, longest_nm : the range; the terms are Legendre polynomials of the wavenumber over it.
    coefficients : 1 is a constant, 2 a straight line in 1/wavelength.
    """

    shortest_nm: float
    longest_nm: float
    coefficients: int

    @classmethod
    def over(cls, wavelengths_nm: Sequence[float], coefficients: int) -> "WavenumberCurve":
        """Curves through values at these wavelengths.

        Raises CalibrationError: there are fewer wavelengths than coefficients, or one wavelength only.
        """
        several = sorted(set(wavelengths_nm))
        if coefficients < 1:
            raise CalibrationError(f"a curve with {coefficients} coefficients: take 1 (a constant) or more")
        if len(several) < max(coefficients, 2):
            raise CalibrationError(
                f"a curve with {coefficients} coefficient{'s' * (coefficients > 1)} needs captures at "
                f"{max(coefficients, 2)} wavelengths or more; these are at {', '.join(f'{w:g}' for w in several)} nm. "
                "Take fewer coefficients, or leave the curve out: then each wavelength has its own values."
            )
        return cls(several[0], several[-1], coefficients)

    def terms(self, wavelength_nm: float) -> NDArray[np.float64]:
        """(coefficients,) by which the coefficients add up to the value at a wavelength.

        Raises CalibrationError: outside the range; a polynomial says nothing there.
        """
        if not self.shortest_nm <= wavelength_nm <= self.longest_nm:
            raise CalibrationError(
                f"{wavelength_nm:g} nm is outside the captures' {self.shortest_nm:g} to {self.longest_nm:g} nm; "
                "the curves are not extrapolated"
            )
        low, high = 1 / self.longest_nm, 1 / self.shortest_nm
        scaled = (2 / wavelength_nm - low - high) / (high - low)
        return np.asarray(legvander(np.array([scaled]), self.coefficients - 1)[0], dtype=float)
