"""Values from which the posterior begins: zero, or the best of many starts where the train is far off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit, minimize
from processing.diagnosis.search.posterior import Say
from processing.diagnosis.search.rules import FAR_OFF, NEAR_ENOUGH
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import SourceEffect, ValuePerState

STARTS = 24
#: Half widths of the starts of nominal values, in degrees: azimuths, which come round again; retardances of plates of a
#: known order, and of elements of which no more than "some retardance" is known.
ANY_AZIMUTH, NEAR, FAR = 90.0, 20.0, 120.0

Values = dict[Candidate, Array]


def first_values(problem: InstrumentProblem, base: Space, pool: Sequence[Candidate], say: Say) -> Values:
    """Values to begin with, of the nominal values and of what else was found beside them."""
    fit = minimize(problem, base, np.zeros(base.size))
    if fit.rms < FAR_OFF:
        return _by_candidate(base, fit.values)
    say("far off: searching from many starts")
    if not base.size:
        return _far(problem, pool, fit)
    if len(set(problem.wavelengths_nm)) == 1:
        return _searched(problem, base, pool, fit)
    return along_wavelengths(problem, base, say)


def _searched(problem: InstrumentProblem, base: Space, pool: Sequence[Candidate], fit: Fit) -> Values:
    # Nominal values are not found beside a source or channels that are as far off.
    free = [
        c
        for c in pool
        if c.kind == "channel_gain" or (isinstance(c.effect, SourceEffect) and isinstance(c.effect, ValuePerState))
    ]
    wide = Space((*base.candidates, *free))
    values = np.concatenate([fit.values, np.zeros(wide.size - base.size)])
    return _by_candidate(wide, _best_start(problem, wide, values, fit.excess))


def best_of_starts(problem: InstrumentProblem, space: Space, starts: int, begin: Array | None = None) -> Fit:
    """The best fit of nominal values alone, from `begin` (K,) and, where that is far off, so many places about it."""
    fit = minimize(problem, space, np.zeros(space.size) if begin is None else begin)
    if fit.rms < FAR_OFF or not starts:
        return fit
    return minimize(
        problem, space, _best_start(problem, space, fit.values, fit.excess, starts, NEAR_ENOUGH), expansions=0
    )


def _best_start(
    problem: InstrumentProblem, space: Space, values: Array, best: float, starts: int = STARTS, enough: float = 0.0
) -> Array:
    """The best of fits from `values` and from many places about zero, if one leaves less than `best`.

    `enough` : relative rms residual below which no better start is looked for.
    """
    random, start = np.random.default_rng(0), values
    for k in range(starts + 1):
        width = _widths(space, NEAR if k % 2 else FAR)
        here = random.uniform(-1, 1, space.size) * width if k else start
        tried = minimize(problem, space, here, expansions=0)
        if tried.excess < best:
            values, best = tried.values, tried.excess
            if tried.rms < enough:
                break
    return values


def _widths(space: Space, retardance: float) -> Array:
    def width(candidate: Candidate) -> float:
        if candidate.kind != "calibrate":
            return 0.0
        if candidate.place.endswith("azimuth_deg"):
            return ANY_AZIMUTH
        return retardance if candidate.place.endswith("_deg") else 0.0

    return np.concatenate([np.zeros(0), *(np.full(c.size, width(c)) for c in space.candidates)])


def _far(problem: InstrumentProblem, pool: Sequence[Candidate], fit: Fit) -> Values:
    best, out = 0.5 * fit.excess, {}
    for candidate in pool:
        for start in candidate.starts:
            tried = minimize(problem, Space((candidate,)), start)
            if tried.excess < best:
                best, out = tried.excess, {candidate: tried.values}
    return out


def along_wavelengths(problem: InstrumentProblem, base: Space, say: Say) -> Values:
    """One wavelength from many starts, the others one after the other from their neighbours', then all together."""
    wavelengths = sorted(set(problem.wavelengths_nm))
    best: Fit | None = None
    for first in (len(wavelengths) // 2, 0, len(wavelengths) - 1):
        found: Values = {}
        upwards = range(first, len(wavelengths))
        for k in (*upwards, *reversed(range(first))):
            at = wavelengths[k]
            neighbour = wavelengths[k - 1 if k > first else k + 1] if k != first else None
            found |= _beside(problem.at(at), base, found, at, neighbour)
        fit = minimize(problem, base, np.concatenate([found[c] for c in base.candidates]))
        say(f"beginning at {wavelengths[first]:g} nm: {100 * fit.rms:.3g} %")
        if best is None or fit.excess < best.excess:
            best = fit
        if best.rms < FAR_OFF:
            break
    else:
        say("no mounts fit all wavelengths: were they homed anew in between? Then give each run by itself")
    return {} if best is None else _by_candidate(base, best.values)


def _beside(problem: InstrumentProblem, base: Space, found: Values, at: float, neighbour: float | None) -> Values:
    """Nominal values at one wavelength; what the wavelengths share is held where it was found."""
    mine, _ = base.acting(0, at)
    gains = [c for c in problem.pool() if c.kind == "channel_gain"]
    space = Space((*mine.candidates, *gains))
    if neighbour is None:
        start = minimize(problem, space, np.zeros(space.size))
        values = start.values
        if start.rms > FAR_OFF:
            values = _best_start(problem, space, values, start.excess)
        return {c: values[p] for c, p in zip(space.candidates, space.slices, strict=True) if c not in gains}
    before = {(c.place, c.wavelength_nm): v for c, v in found.items()}
    parts = [before.get((c.place, neighbour), found.get(c, np.zeros(c.size))) for c in space.candidates]
    free = np.concatenate([np.full(c.size, c not in found) for c in space.candidates])
    values = minimize(problem, space, np.concatenate(parts), free=free).values
    return {
        c: values[p] for c, p in zip(space.candidates, space.slices, strict=True) if c not in gains and c not in found
    }


def _by_candidate(space: Space, values: Array) -> Values:
    return {c: values[p] for c, p in zip(space.candidates, space.slices, strict=True)}
