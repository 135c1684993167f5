"""Parts of an answer about an instrument alone: nominal values, captures, excluded data, and the noise."""

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES, features
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.structure import Residual
from processing.diagnosis.search.fit import Solution
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.result import CaptureReport, NoiseReport, NotMeasured
from processing.diagnosis.search.space import Space
from processing.diagnosis.verdict.answer import error
from processing.instrument.changes import places
from processing.instrument.model import EffectParameter


def closure(problem: InstrumentProblem, k: int, space: Space, values: Array) -> float | None:
    """Mean of I0 + I90 - I45 - I135 over mean S0, percent, of corrected counts over the gains of their channels."""
    model, data = problem.models[k], problem.captures[k]
    if model.mosaic is None or {c.name for c in model.channels} != {"0", "45", "90", "135"}:
        return None
    changes = problem.changes(k, space, values)
    coefficients = problem.coefficients(k, changes).reshape(len(FEATURES), *data.signal.shape[:2])
    good = data.usable & ~data.clipped
    if not good.any():
        return None
    means, place = np.zeros(len(model.channels)), [x[good] for x in places(*good.shape)]
    for channel, c in enumerate(model.channels):
        sign = 1.0 if c.name in ("0", "90") else -1.0
        for state in range(data.signal.shape[0]):
            counts = data.signal[state, channel][good].astype(np.float64)
            corrected = np.tensordot(coefficients[:-DERIVATIVES, state, channel], features(counts, *place)[0], axes=1)
            means[channel] += sign * corrected.mean() / changes.gain[state, channel]
    return float(100 * means.sum() / (np.abs(means).sum() / 2))


def calibrated(problem: InstrumentProblem, posterior: Posterior, solved: Solution) -> dict[str, EffectParameter]:
    """Nominal values as fitted: one number, or one for each wavelength where they differ."""
    part = dict(posterior.space.pairs)
    values: dict[str, dict[float, tuple[float, float]]] = {}
    nominal = {c: p for c, p in solved.base.pairs if c.place}
    for candidate, where in nominal.items():
        covariance = posterior.covariance[part[candidate], part[candidate]]
        for single, (fitted,), ((variance,),) in candidate.by_wavelength(solved.fit.values[where], covariance):
            for model, wavelength in zip(problem.models, problem.wavelengths_nm, strict=True):
                if single.wavelength_nm in (None, wavelength):
                    start = float(model.value_of(candidate.place))  # type: ignore[arg-type]
                    value = start + float(fitted), float(np.sqrt(max(variance, 0.0)))
                    values.setdefault(candidate.place, {})[wavelength] = value
    unit = {c.place: c.parameters[0].unit for c in nominal}
    return {place: _by_wavelength(each, unit[place]) for place, each in values.items()}


def _by_wavelength(values: dict[float, tuple[float, float]], unit: str) -> EffectParameter:
    at = tuple(sorted(values))
    value, stderr = zip(*(values[w] for w in at), strict=True)
    if len(set(value)) == 1:
        return EffectParameter(value=value[0], stderr=stderr[0], unit=unit)
    return EffectParameter(value=value, stderr=stderr, unit=unit, wavelengths_nm=at)


def capture_report(
    problem: InstrumentProblem, k: int, solved: Solution, before: Residual, *, after: Residual
) -> CaptureReport:
    data = problem.captures[k]
    sample = "unknown" if data.sample is None else "known up to a throughput for each pixel"
    return CaptureReport(
        name=data.name,
        sample=sample,
        simulated=data.simulated,
        noise=data.noise_source,
        evidence=data.evidence,
        binned=data.binned,
        clipped_fraction=float(np.mean(data.clipped)),
        dark_fraction=data.dark_fraction,
        steep_fraction=0.0 if data.steep is None else float(data.steep.mean()),
        cut_off=data.cut_off,
        source_percent=_source_percent(problem, k, solved),
        wavelength_nm=data.wavelength_nm,
        error_before=error(problem, solved.undone, solved.before.of(k), k),
        error_after=error(problem, solved, solved.after.of(k), k),
        tests_before=before.tests,
        tests_after=after.tests,
        closure_before_percent=closure(problem, k, solved.base, solved.before_fit.values),
        closure_after_percent=closure(problem, k, solved.space, solved.fit.values),
    )


def _source_percent(problem: InstrumentProblem, k: int, solved: Solution) -> float | None:
    """Standard deviation of the level of the source over the states, where channels tell it."""
    if not problem.has_free_level(k):
        return None
    slices = dict(solved.space.pairs)
    levels = [p for c, p in slices.items() if c.effect.is_projected and c.capture == k]
    level = 1 + solved.fit.values[levels[0]] if levels else None
    if level is None:
        data, acting = problem.captures[k], solved.space.acting(k, problem.wavelengths_nm[k])
        expected = problem.predicted(k, problem.changes(k, acting.space, acting.of(solved.fit.values)))
        measured = data.signal[:, :, data.usable].mean(axis=2, dtype=float)
        level = np.sum(measured * expected, axis=1) / np.sum(expected**2, axis=1)
    return 100 * float(np.std(level) / np.mean(level))


def not_measured(problem: InstrumentProblem) -> tuple[NotMeasured, ...]:
    """Frames, hits and pixels that were left out, as the frames are stored."""
    entries = []
    for data in problem.captures:
        excluded = data.left_out
        if excluded:
            entries.append(
                NotMeasured(
                    capture=data.name,
                    states=tuple(excluded.frames),
                    misfits_percent=tuple(100 * m for m in excluded.frames.values()),
                    exchanged=excluded.exchanged,
                    hits=tuple((n, c, y * excluded.pitch, x * excluded.pitch) for n, c, y, x in excluded.hits.tolist()),
                    pixels=tuple((y * excluded.pitch, x * excluded.pitch) for y, x in excluded.pixels.tolist()),
                    pitch=excluded.pitch,
                )
            )
    return tuple(entries)


def noise_report(problem: InstrumentProblem) -> NoiseReport:
    """Whether the noise is what is declared."""
    several = len(problem.captures) > 1
    lines = tuple(f"{c.name}: {line}" if several else line for c in problem.captures for line in c.told_of_noise)
    if lines:
        return NoiseReport(verdict="not_as_declared", told=lines)
    if not problem.noise_known:
        return NoiseReport(verdict="unknown")
    return NoiseReport(verdict="estimated" if any(c.noise_estimated for c in problem.captures) else "as_declared")
