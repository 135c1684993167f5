"""What could be reached: a fit of the true set of faults, and of nothing else, to the same captures.

The fit is that of `diagnose`, with the distribution that the sizes were drawn from as its prior: what the captures do
not determine stays as small as it is on a bench of this suite.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.captures.screening import screen_capture
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import minimize
from processing.diagnosis.search.rules import NOMINAL_TAU
from processing.diagnosis.search.space import Space
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.storage.captures.capture import Capture
from simulators.blind.bench_judge import GIVEN, active
from simulators.blind.lab_priors import PRIORS
from simulators.blind.mueller_error import error_of
from simulators.blind.real_bench import VALIDATION, RealBench, TrueFault


def fit_of_the_truth(
    captures: Sequence[Path], model: InstrumentModel, faults: Iterable[TrueFault]
) -> InstrumentModel | None:
    """The instrument model with the true kinds at the true places, values fitted; None if no effect has these kinds."""
    data = []
    for path in captures:
        with Capture(path) as capture:
            instrument = model.at(capture.header.wavelength_nm)
            data.append(screen_capture(read_capture(capture, instrument), instrument, lambda line: None))
    problem = InstrumentProblem(model.at(data[0].wavelength_nm), data)
    numbers = {path.stem: k for k, path in enumerate(captures)}
    keys = {(f.kind, f.place, numbers.get(f.capture) if f.capture else None) for f in faults}
    space = Space(tuple(_set_prior_width(c) for c in problem.pool() if (c.kind, c.place, c.capture) in keys))
    if not space.size:
        return None
    fit = minimize(problem, space, np.zeros(space.size))
    names = tuple(d.name for d in data)
    parts = zip(space.candidates, space.slices, strict=True)
    effects = [_applied(c, fit.values[s], names, data[0].wavelength_nm) for c, s in parts]
    return model.model_copy(update={"effects": (*model.effects, *effects)})


def read_oracle(folder: Path, truth: RealBench, configs: Path, capture_set: str) -> float:
    """Error of M / m00 of the validation sample after a fit of the true set; cached next to the truth."""
    base = folder / "truth" / truth.name
    cache = base / f"oracle_{capture_set}.json"
    if cache.exists():
        return float(json.loads(cache.read_text(encoding="utf-8")))
    captures = [folder / truth.name / f"{name}.h5" for name in GIVEN[capture_set]]
    declared = InstrumentModel.load(configs / "instruments" / truth.instrument)
    best = fit_of_the_truth(captures, declared, active(truth, GIVEN[capture_set]))
    error = float("nan")
    if best is not None:
        error = error_of(base / f"{VALIDATION}.h5", best, np.load(base / f"{VALIDATION}.npy").astype(float))
    cache.write_text(json.dumps(error), encoding="utf-8")
    return error


def _set_prior_width(candidate: Candidate) -> Candidate:
    width = PRIORS[candidate.kind].rms / NOMINAL_TAU
    return replace(candidate, parameters=tuple(replace(p, typical=width) for p in candidate.parameters))


def _applied(candidate: Candidate, values: Array, names: tuple[str, ...], wavelength_nm: float) -> AppliedEffect:
    unit = candidate.parameters[0].unit
    if candidate.effect.per_state:
        parameters = {"states": EffectParameter(value=tuple(map(float, values)), unit=unit)}
    else:
        pairs = zip(candidate.parameters, values, strict=True)
        parameters = {p.name: EffectParameter(value=float(v), unit=p.unit) for p, v in pairs}
    return AppliedEffect(
        kind=candidate.kind,
        element=candidate.place or None,
        parameters=parameters,
        captures=names if candidate.capture is None else (names[candidate.capture],),
        scope="instrument" if candidate.capture is None else "capture",
        wavelength_nm=wavelength_nm,
    )
