"""Which values of an instrument's trains can be fitted, and what captures at several wavelengths share of them.

Every value is linear in what is searched: a mount's change is one number for all captures, a value of optics has a
number at each wavelength, or the coefficients of a curve.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.calibration.known_sample import CalibrationError
from processing.calibration.wavenumber_curve import WavenumberCurve
from processing.instrument.model import Element, InstrumentModel

#: Fields of an element that can be fitted, with the size of a sensible step and the bounds.
FITTABLE = {
    "azimuth_deg": (1.0, -np.inf, np.inf),
    "retardance_deg": (1.0, -np.inf, np.inf),
    "extinction": (0.01, 0.0, 1.0),
    "diattenuation": (0.01, -1.0, 1.0),
    "t_max": (0.01, 0.0, np.inf),
    "t_min": (0.01, 0.0, np.inf),
    "ratio": (0.001, -np.inf, np.inf),
}
#: Fields that belong to a mount, unless the instrument's `belongs_to` says otherwise: by how much they differ from the
#: file is the same at every wavelength.
MECHANICAL = ("azimuth_deg", "ratio")


def check_names(model: InstrumentModel, free: Sequence[str]) -> tuple[str, ...]:
    """The free parameters, each once; CalibrationError names what this instrument does not have."""
    names = tuple(dict.fromkeys(name.strip() for name in free if name.strip()))
    offered = [f"{e.name}.{field}" for e in model.elements() for field in FITTABLE if _fits(e, field)]
    unknown = [name for name in names if name not in offered]
    if unknown or not names:
        listed = ", ".join(unknown) or "none given"
        raise CalibrationError(f"free parameter: {listed}. This instrument has: {', '.join(offered)}.")
    return names


def belongs_to(model: InstrumentModel, name: str) -> str:
    """The class of a value: "mechanics", "dispersion" or another of the instrument file's words."""
    rule = "mechanics" if name.rpartition(".")[2] in MECHANICAL else "dispersion"
    return model.belongs_to.get(name, rule)


def values_of(model: InstrumentModel, names: Sequence[str]) -> NDArray[np.float64]:
    """(K,) values of a model at one wavelength."""
    elements = {e.name: e for e in model.elements()}
    return np.array([float(getattr(elements[n.rpartition(".")[0]], n.rpartition(".")[2])) for n in names])


def with_values(model: InstrumentModel, names: Sequence[str], values: NDArray[np.float64]) -> InstrumentModel:
    """The model with other values (K,) of these names."""
    new: dict[str, dict[str, Any]] = {}
    for name, value in zip(names, values, strict=True):
        element, _, field = name.rpartition(".")
        new.setdefault(element, {})[field] = float(value)
    return model.with_values(new)


@dataclass(frozen=True)
class Unknown:
    """One number that is searched: of a value's change at all wavelengths, its value at one, or a term of its curve."""

    name: str
    wavelength_nm: float | None = None
    term: int | None = None


@dataclass(frozen=True)
class TrainValues:
    """How the free values at a wavelength follow from what is searched.

    Attributes
    ----------
    names : (K,) "element.field"; unknown : (U,); curve : None where no value follows one.
    """

    names: tuple[str, ...]
    unknown: tuple[Unknown, ...]
    curve: WavenumberCurve | None = None

    @classmethod
    def shared(
        cls,
        model: InstrumentModel,
        names: Sequence[str],
        wavelengths_nm: Sequence[float],
        curve: WavenumberCurve | None,
    ) -> "TrainValues":
        """Mounts once, other values along the curve; at each wavelength without a curve, or if the file asks."""
        unknown: list[Unknown] = []
        for name in names:
            belongs = belongs_to(model, name)
            if belongs == "mechanics":
                unknown.append(Unknown(name))
            elif belongs == "dispersion" and curve is not None:
                unknown += [Unknown(name, term=t) for t in range(curve.coefficients)]
            else:
                unknown += [Unknown(name, wavelength_nm=w) for w in dict.fromkeys(wavelengths_nm)]
        curved = curve if any(u.term is not None for u in unknown) else None
        return cls(tuple(names), tuple(unknown), curved)

    @property
    def curved(self) -> tuple[str, ...]:
        """Names of the values that follow a curve."""
        return tuple(dict.fromkeys(u.name for u in self.unknown if u.term is not None))

    @property
    def scale(self) -> NDArray[np.float64]:
        """(3, U): step, lower and upper bound of what is searched."""
        limits = np.array([FITTABLE[u.name.rpartition(".")[2]] for u in self.unknown]).T
        coefficient = np.array([u.term is not None for u in self.unknown])
        limits[1:, coefficient] = np.array([[-np.inf], [np.inf]])
        return limits

    def base(self, nominal: NDArray[np.float64]) -> NDArray[np.float64]:
        """(K,) to which what is searched is added: the values of the file where a change is searched."""
        changed = [u.name for u in self.unknown if u.wavelength_nm is None and u.term is None]
        return np.where(np.isin(self.names, changed), nominal, 0.0)

    def matrix(self, wavelength_nm: float) -> NDArray[np.float64]:
        """(K, U): the values at a wavelength are `base + matrix @ searched`.

        Raises CalibrationError: the wavelength is outside the curve, or a value is known at the captures' wavelengths
        alone.
        """
        terms = None if self.curve is None else self.curve.terms(wavelength_nm)
        matrix = np.zeros((len(self.names), len(self.unknown)))
        for column, unknown in enumerate(self.unknown):
            row = self.names.index(unknown.name)
            if unknown.term is not None and terms is not None:
                matrix[row, column] = terms[unknown.term]
            elif unknown.wavelength_nm in (None, wavelength_nm):
                matrix[row, column] = 1.0
        open_ones = [name for name, row in zip(self.names, matrix, strict=True) if not row.any()]
        if open_ones:
            raise CalibrationError(f"{', '.join(open_ones)}: no value at {wavelength_nm:g} nm follows from the others")
        return matrix

    def nearest(
        self,
        wavelengths_nm: Sequence[float],
        nominal: Sequence[NDArray[np.float64]],
        targets: Sequence[NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """(U,) what is searched, so that the values come nearest to wanted ones (K,) of each part."""
        rows = np.concatenate([self.matrix(w) for w in wavelengths_nm])
        added = np.concatenate([v - self.base(n) for v, n in zip(targets, nominal, strict=True)])
        return np.asarray(np.linalg.lstsq(rows, added, rcond=None)[0])

    def check_range(self, model: InstrumentModel, values: NDArray[np.float64], wavelength_nm: float) -> None:
        """CalibrationError where a curve leaves what a value can be."""
        for name, value in zip(self.names, values, strict=True):
            _, lower, upper = FITTABLE[name.rpartition(".")[2]]
            if name in self.curved and not lower <= value <= upper:
                raise CalibrationError(
                    f"the curve of {name} is {value:.3g} at {wavelength_nm:g} nm, where {lower:g} to {upper:g} is "
                    f"possible: take fewer coefficients, hold it fixed, or write `{name}: wavelength` under belongs_to "
                    f"of the instrument {model.name!r}"
                )


def _fits(element: Element, field: str) -> bool:
    return hasattr(element, field) and (field != "ratio" or element.axis is not None)
