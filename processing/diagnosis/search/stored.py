"""How values of a candidate are stored in an instrument file."""

from __future__ import annotations

from typing import Literal

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.instrument.effects.base import OfOneCapture, Switch, ValuePerState
from processing.instrument.model import EffectParameter


def parameters_of(candidate: Candidate, values: Array, stderr: Array) -> dict[str, EffectParameter]:
    """Values by name, each with its standard error."""
    if isinstance(candidate.effect, Switch):
        return {"left_out": EffectParameter(value=1.0, unit="1", note="pixels with a clipped state are left out")}
    if isinstance(candidate.effect, ValuePerState):
        unit = candidate.parameters[0].unit
        return {"states": EffectParameter(value=tuple(values.tolist()), stderr=tuple(stderr.tolist()), unit=unit)}
    return {
        p.name: EffectParameter(value=float(v), stderr=float(s), unit=p.unit)
        for p, v, s in zip(candidate.parameters, values, stderr, strict=True)
    }


def scope_of(candidate: Candidate) -> Literal["instrument", "capture"]:
    """Whether it holds for the instrument or for one capture of it."""
    return "capture" if isinstance(candidate.effect, OfOneCapture) else "instrument"
