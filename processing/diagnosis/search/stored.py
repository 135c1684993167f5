"""How values of a candidate are stored in an instrument file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.instrument.model import EffectParameter


def parameters_of(candidate: Candidate, values: Array, stderr: Array) -> dict[str, EffectParameter]:
    """Values by name, each with its standard error."""
    if candidate.effect.is_switch:
        return {"left_out": EffectParameter(value=1.0, unit="1", note="pixels with a clipped state are left out")}
    if candidate.effect.per_state:
        unit = candidate.parameters[0].unit
        return {"states": EffectParameter(value=tuple(values.tolist()), stderr=tuple(stderr.tolist()), unit=unit)}
    return {
        p.name: EffectParameter(value=float(v), stderr=float(s), unit=p.unit)
        for p, v, s in zip(candidate.parameters, values, stderr, strict=True)
    }


def scope_of(candidate: Candidate) -> Literal["instrument", "capture"]:
    """Whether it holds for the instrument or for one capture of it."""
    return "capture" if candidate.effect.of_one_capture else "instrument"


def by_wavelength(candidate: Candidate, values: Array, covariance: Array) -> Iterator[tuple[Candidate, Array, Array]]:
    """The candidate, its values (n,) and their covariance (n, n); of a curve, each at every one of its wavelengths."""
    if candidate.curve is None:
        yield candidate, values, covariance
        return
    for wavelength in candidate.curve.wavelengths_nm:
        mix = candidate.matrix(wavelength)
        yield candidate.at(wavelength), mix @ values, mix @ covariance @ mix.T
