"""Fit parameters of an instrument's trains to captures of known samples, by nonlinear least squares.

Captures at several wavelengths are fitted at once: what a mount does is the same in all of them; what a plate does is
not, or follows a smooth curve.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import approx_fprime, least_squares
from scipy.special import fdtrc

from processing.calibration.known_sample import CalibrationError, KnownCapture
from processing.calibration.train_values import FITTABLE, TrainValues, check_names, values_of, with_values
from processing.calibration.wavenumber_curve import WavenumberCurve
from processing.errors import NotDetermined
from processing.instrument.model import InstrumentModel

#: A residual above this part of the mean signal is no fit.
POOR_FIT = 0.05
#: Chance below which curves do not fit.
UNLIKELY = 1e-3
#: Other starts turn at most this many azimuths by 45 degrees.
MOST_TURNED = 5
#: Parameter directions with a singular value below this, relative to the largest, are not determined.
UNSEEN = 1e-7
#: KnownCapture of a sensible step of a parameter over which derivatives are taken.
DIFFERENCE = 1e-6
#: Least residual over the mean signal that a wavelength is weighted by: exact data would outweigh all others.
LEAST_RESIDUAL = 1e-6


@dataclass(frozen=True)
class FittedValues:
    """Values at one wavelength.

    Attributes
    ----------
    names : of the free parameters, "element.field".
    values : (K,), in the unit of each field (degrees for angles).
    covariance : (K, K); scaled with the residual, because noise alone rarely explains it.
    model : the instrument model with these values.
    """

    names: tuple[str, ...]
    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    model: InstrumentModel

    @property
    def stderr(self) -> NDArray[np.float64]:
        """(K,) standard errors."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True)
class Calibration(FittedValues):
    """Values fitted to one capture.

    Attributes
    ----------
    residual_over_mean : rms of the residual over the mean signal.
    residual : (N, channels) relative to the mean signal.
    """

    residual_over_mean: float
    residual: NDArray[np.float64]


@dataclass(frozen=True)
class CurveFit:
    """Calibrations whose optics follow a smooth curve over the wavelengths.

    Attributes
    ----------
    calibrations : one for each part, in their order.
    curved : names of the values that follow a curve.
    residual_over_mean : rms over all parts; separate_residual : that of the fit with a value at each wavelength.
    chance : that the curves would be worse than that by as much, if they were true (F test in units of the separate
        fit's residual); None where there are as many coefficients as wavelengths.
    shared : what the wavelengths have in common; searched : (U,) what was found of it; covariance : (U, U).
    """

    calibrations: tuple[Calibration, ...]
    curved: tuple[str, ...]
    residual_over_mean: float
    separate_residual: float
    chance: float | None
    shared: TrainValues
    searched: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def at(self, model: InstrumentModel, wavelength_nm: float) -> FittedValues:
        """Values of the curves and mounts at another wavelength inside the range.

        Parameters
        ----------
        model : the instrument file's, not yet at a wavelength.

        Raises
        ------
        CalibrationError : outside the range, or a value has no curve.
        WavelengthError : a value that is not fitted is not given there.
        """
        matrix = self.shared.matrix(wavelength_nm)
        nominal = model.model_copy(update={"calibrate": self.shared.names, "wavelengths_nm": None})
        return _fit_values(
            self.shared, nominal.nominal_at(wavelength_nm), matrix, self.searched, covariance=self.covariance
        )


def fit_trains(parts: Sequence[KnownCapture], free: Sequence[str]) -> list[Calibration]:
    """Fit the free parameters to signals of known samples; the search starts from the values of the models.

    Parameters
    ----------
    free : "element.field", fields as in FITTABLE. Those of a mount (MECHANICAL, or `belongs_to` of the instrument)
        change by the same amount in all parts, the others take a value of their own at each wavelength.

    Returns
    -------
    One for each part, in their order.

    Raises
    ------
    CalibrationError : an unknown parameter, or fewer data than parameters.
    NotDetermined : the data leave a combination of parameters open; the message names them.
    """
    names = check_names(parts[0].model, free)
    fit = _Fit(parts, TrainValues.shared(parts[0].model, names, _wavelengths(parts), None))
    minimum = fit.searched_from(fit.nominal, np.ones(len(parts)))
    if len(set(_wavelengths(parts))) > 1:
        minimum = fit.searched_from(fit.values(minimum.x), fit.units(minimum))
    return fit.calibrations(minimum)


def fit_curves(parts: Sequence[KnownCapture], free: Sequence[str], coefficients: int) -> CurveFit:
    """`fit_trains`, where values of optics follow a polynomial in 1/wavelength over the parts' wavelengths.

    What `belongs_to` of the instrument declares as "wavelength" keeps a value of its own at each.

    Raises
    ------
    CalibrationError : as in `fit_trains`; fewer wavelengths than coefficients; no free parameter follows a curve; a
        curve leaves what its value can be.
    NotDetermined : as in `fit_trains`.
    """
    names = check_names(parts[0].model, free)
    wavelengths = _wavelengths(parts)
    curve = WavenumberCurve.over(wavelengths, coefficients)
    smooth = _Fit(parts, TrainValues.shared(parts[0].model, names, wavelengths, curve))
    if not smooth.shared.curved:
        raise CalibrationError(f"none of {', '.join(names)} follows a curve: each belongs to a mount or a wavelength")
    # First with a value at each wavelength: it tells the noise of each, and the valley in which the curves lie.
    separate = _Fit(parts, TrainValues.shared(parts[0].model, names, wavelengths, None))
    first = separate.searched_from(separate.nominal, np.ones(len(parts)))
    units = separate.units(first)
    free_fit = separate.searched_from(separate.values(first.x), units)
    minimum = smooth.searched_from(separate.values(free_fit.x), units)
    chance = _chance(minimum, smooth.freedom, free_fit, separate.freedom)
    if chance is not None and chance < UNLIKELY:
        # Some of the values at a wavelength may lie in another valley than the rest.
        second = smooth.searched_from(smooth.nominal, units)
        minimum = min(minimum, second, key=lambda f: float(f.cost))
        chance = _chance(minimum, smooth.freedom, free_fit, separate.freedom)
    calibrations = smooth.calibrations(minimum)
    for part, calibration in zip(parts, calibrations, strict=True):
        smooth.shared.check_range(part.model, calibration.values, part.wavelength_nm)
    return CurveFit(
        calibrations=tuple(calibrations),
        curved=smooth.shared.curved,
        residual_over_mean=smooth.rms(minimum.x),
        separate_residual=separate.rms(free_fit.x),
        chance=chance,
        shared=smooth.shared,
        searched=minimum.x,
        covariance=smooth.covariance(minimum),
    )


class _Fit:
    """The search over what some captures share."""

    def __init__(self, parts: Sequence[KnownCapture], shared: TrainValues) -> None:
        self.parts, self.shared = parts, shared
        self.nominal = [values_of(part.model, shared.names) for part in parts]
        self._bases = [shared.base(values) for values in self.nominal]
        self._matrices = [shared.matrix(part.wavelength_nm) for part in parts]
        self._edges = np.cumsum([part.data.size for part in parts])[:-1]
        throughputs = sum(part.throughputs for part in parts)
        size = sum(part.data.size for part in parts)
        self.freedom = size - throughputs - len(shared.unknown)
        if self.freedom <= 0:
            raise CalibrationError(f"{size} intensities cannot fix {len(shared.unknown)} parameters and the throughput")

    def values(self, searched: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """(K,) of each part."""
        return [base + matrix @ searched for base, matrix in zip(self._bases, self._matrices, strict=True)]

    def models(self, searched: NDArray[np.float64]) -> list[InstrumentModel]:
        """One for each part."""
        tried = zip(self.parts, self.values(searched), strict=True)
        return [with_values(part.model, self.shared.names, values) for part, values in tried]

    def rms(self, searched: NDArray[np.float64]) -> float:
        """Rms of the residuals of all parts, each over its mean signal."""
        each = zip(self.parts, self.models(searched), strict=True)
        return float(np.sqrt(np.mean(np.concatenate([part.residual(model) for part, model in each]) ** 2)))

    def searched_from(self, values: Sequence[NDArray[np.float64]], units: NDArray[np.float64]) -> Any:
        """The nearest minimum, or that of other azimuths where it is no fit; in `units` (parts,) of the mean."""
        step, lower, upper = self.shared.scale

        def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
            each = zip(self.parts, self.models(x), units, strict=True)
            return np.concatenate([part.residual(model) / unit for part, model, unit in each])

        def derivative(x: NDArray[np.float64]) -> NDArray[np.float64]:
            # By the few values of each part, not by everything that all parts together search.
            each = zip(self.parts, self.values(x), self._matrices, units, strict=True)
            return np.concatenate([self._derivative(part, v) @ m / unit for part, v, m, unit in each])

        def search(x0: NDArray[np.float64]) -> Any:
            inside = np.clip(x0, lower + 1e-9 * step, upper - 1e-9 * step)
            bounds = (lower, upper)
            return least_squares(residual, inside, derivative, bounds, x_scale=step, xtol=1e-12, ftol=1e-12)

        wavelengths = _wavelengths(self.parts)
        start = self.shared.nearest(wavelengths, self.nominal, values)
        minimum = search(start)
        if self.rms(minimum.x) > POOR_FIT:
            # Azimuths have several valleys; a residual like this is the bottom of a wrong one.
            minimum = min([minimum, *(search(x0) for x0 in self._azimuth_starts(start))], key=lambda f: float(f.cost))
        if not minimum.success:
            raise NotDetermined(
                f"the fit did not converge ({minimum.message}); start from an instrument file closer to the truth"
            )
        return minimum

    def units(self, minimum: Any) -> NDArray[np.float64]:
        """(parts,) rms of the residual over the mean signal at the wavelength of each, noise that the fit took added.

        Of a fit in units of the mean signal itself.
        """
        # What each intensity pulls the fit to itself: the diagonal of the projection onto the derivatives.
        u, singular, _ = np.linalg.svd(minimum.jac * self.shared.scale[0], full_matrices=False)
        pulled = np.split(np.sum(u[:, singular > UNSEEN * singular[0]] ** 2, axis=1), self._edges)
        residuals = np.split(minimum.fun, self._edges)
        wavelengths = np.array(_wavelengths(self.parts))
        units = np.empty(len(self.parts))
        for nm in np.unique(wavelengths):
            index = np.flatnonzero(wavelengths == nm).tolist()
            square = sum(float(np.sum(residuals[k] ** 2)) for k in index)
            free = sum(self.parts[k].data.size - self.parts[k].throughputs - float(pulled[k].sum()) for k in index)
            total = float(np.sum(minimum.fun**2)) / self.freedom
            units[index] = max(np.sqrt(square / free if free >= 1 else total), LEAST_RESIDUAL)
        return units

    def covariance(self, minimum: Any) -> NDArray[np.float64]:
        """Covariance (U, U) of the unknowns. Raises NotDetermined: a combination of parameters is left open."""
        step = self.shared.scale[0]
        jacobian = minimum.jac * step
        _, singular, vt = np.linalg.svd(jacobian, full_matrices=False)
        if singular[-1] <= UNSEEN * singular[0]:
            open_ones = dict.fromkeys(self.shared.unknown[k].name for k in np.flatnonzero(np.abs(vt[-1]) > 0.1))
            if len(open_ones) == 1:
                raise NotDetermined(
                    f"the data look the same whatever {next(iter(open_ones))} is. Hold it fixed, or capture another "
                    "known sample (kind mueller), for instance a polarizer."
                )
            raise NotDetermined(f"the data do not tell apart: {', '.join(open_ones)}. Hold one of them fixed.")
        variance = 2 * float(minimum.cost) / self.freedom
        return np.asarray(np.linalg.inv(jacobian.T @ jacobian) * variance * np.outer(step, step))

    def calibrations(self, minimum: Any) -> list[Calibration]:
        """One for each part."""
        covariance = self.covariance(minimum)
        calibrations = []
        for part, matrix in zip(self.parts, self._matrices, strict=True):
            fitted = _fit_values(self.shared, part.model, matrix, minimum.x, covariance=covariance)
            residual = part.residual(fitted.model)
            calibrations.append(
                Calibration(
                    **vars(fitted),
                    residual_over_mean=float(np.sqrt(np.mean(residual**2))),
                    residual=residual.reshape(*part.signal.shape[:2], -1).mean(axis=2),
                )
            )
        return calibrations

    def _derivative(self, part: KnownCapture, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N * channels * pixels, K) of the residual by the values of a part."""
        names = self.shared.names
        small = DIFFERENCE * np.array([FITTABLE[name.rpartition(".")[2]][0] for name in names])

        def residual(tried: NDArray[np.float64]) -> NDArray[np.float64]:
            return part.residual(with_values(part.model, names, tried))

        return np.asarray(approx_fprime(values, residual, small))

    def _azimuth_starts(self, start: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        azimuths = [
            k for k, u in enumerate(self.shared.unknown) if u.name.endswith(".azimuth_deg") and u.term in (None, 0)
        ][:MOST_TURNED]
        starts = []
        for turned in product((0.0, 45.0), repeat=len(azimuths)):
            if any(turned):
                x0 = start.copy()
                x0[azimuths] += turned
                starts.append(x0)
        return starts


def _fit_values(
    shared: TrainValues,
    model: InstrumentModel,
    matrix: NDArray[np.float64],
    searched: NDArray[np.float64],
    *,
    covariance: NDArray[np.float64],
) -> FittedValues:
    values = shared.base(values_of(model, shared.names)) + matrix @ searched
    return FittedValues(shared.names, values, matrix @ covariance @ matrix.T, with_values(model, shared.names, values))


def _chance(minimum: Any, freedom: int, free_fit: Any, separate_freedom: int) -> float | None:
    """F test of the curves against a value at each wavelength; None where both are the same."""
    held = freedom - separate_freedom
    if held == 0:
        return None
    worse = (minimum.cost - free_fit.cost) / held / (free_fit.cost / separate_freedom)
    return float(fdtrc(held, separate_freedom, worse))


def _wavelengths(parts: Sequence[KnownCapture]) -> list[float]:
    return [part.wavelength_nm for part in parts]
