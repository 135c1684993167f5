"""Values from which the posterior begins: zero, or the best of many starts where the train is far off.

Several turns of elements fit equally well. An element turned by half a turn is the same. A retarder turned by a quarter
turn has the opposite retardance. Where all retarders have it, a sample without circular polarization (air, a mirror)
looks the same: row and column 3 of every later Mueller matrix then change their sign. Of these branches the one nearest
to the instrument file is taken.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from processing.arrays import Array, BoolArray
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit, minimize
from processing.diagnosis.search.posterior import Say
from processing.diagnosis.search.range_of import NEARLY_ZERO
from processing.diagnosis.search.rules import FAR_OFF, LITTLE, NOMINAL_DEG
from processing.diagnosis.search.space import Space
from processing.instrument.elements import number

#: [places] From which nominal values are fitted.
STARTS = 24


Values = dict[Candidate, Array]


@dataclass(frozen=True)
class Branch:
    """Values on the branch nearest to the instrument file.

    Attributes
    ----------
    values : of all candidates.
    told : what was decided by the instrument file alone, in a sentence; None where the data determine it.
    """

    values: Values
    message: str | None


def nearest_branch(problem: InstrumentProblem, estimates: Mapping[Candidate, Array]) -> Branch:
    """The values found, on the branch whose azimuths are nearest to the instrument file."""
    values = _of_nominal_retardance(problem, estimates)
    # An azimuth turned by half a turn is the same.
    values |= {c: _turn(c, v, -180.0 * round(_mean(c, v) / 180.0)) for c, v in values.items() if _is_azimuth(c)}
    places = sorted({c.place for c in values if _is_azimuth(c)})
    excess = _excess(problem, values)
    branches: list[tuple[tuple[str, ...], Values]] = [((), values)]
    for count in range(1, len(places) + 1):
        for turned in combinations(places, count):
            mirrored = _turn_quarter(problem, values, turned)
            if _excess(problem, mirrored) <= excess * (1 + LITTLE):
                branches.append((turned, mirrored))
    branches.sort(key=lambda branch: _distance(branch[1], places))
    (turned, best), *rivals = branches
    if not rivals:
        return Branch(best, None)
    second, mirrored = rivals[0]
    differ = sorted(set(turned) ^ set(second))
    return Branch(
        best,
        f"the captures fit as well with {' and '.join(name.rpartition('.')[0] for name in differ)} turned by 90 "
        "degrees, where row 3 and column 3 of M have the other sign. The instrument file decides: its azimuths are "
        f"{_distance(best, differ):.0f} degrees from those taken and {_distance(mirrored, differ):.0f} from the others "
        "(rms)",
    )


def _of_nominal_retardance(problem: InstrumentProblem, estimates: Mapping[Candidate, Array]) -> Values:
    """The values with retardances nearest to the instrument file: that of d, -d and 360 - d, a quarter turn apart."""
    values = dict(estimates)
    azimuths = {c.place.rpartition(".")[0]: c for c in values if _is_azimuth(c)}
    for candidate, value in estimates.items():
        element, _, field = candidate.place.rpartition(".")
        if field != "retardance_deg" or candidate.curve is not None or not candidate.effect.is_nominal:
            continue
        nominal = number(problem.model.value_of(candidate.place) or 0.0)
        same, opposite = (_near_zero(sign * (nominal + value[0]) - nominal) for sign in (1, -1))
        azimuth = azimuths.get(element)
        nearer = abs(same) - abs(opposite)
        # A half-wave plate has both at one distance: then the smaller retardance is taken, and the azimuth decides.
        turns = nearer > NEARLY_ZERO or (nearer > -NEARLY_ZERO and opposite < same)
        if turns and azimuth is not None and azimuth.wavelength_nm == candidate.wavelength_nm:
            values[azimuth] = _turn(azimuth, values[azimuth], 90.0)
            same = opposite
        values[candidate] = np.array([same])
    return values


def _near_zero(retardance_deg: float) -> float:
    return float((retardance_deg + 180.0) % 360.0 - 180.0)


def _is_azimuth(candidate: Candidate) -> bool:
    return candidate.effect.is_nominal and candidate.place.endswith(".azimuth_deg")


def _mean(candidate: Candidate, values: Array) -> float:
    """Azimuth over its nominal value, mean over the wavelengths of a curve."""
    if candidate.curve is None:
        return float(values[0])
    return float(np.mean(candidate.curve.basis @ values))


def _turn(candidate: Candidate, values: Array, by_deg: float) -> Array:
    if candidate.curve is None or not by_deg:
        return values + by_deg
    return values + candidate.curve.through(np.full((len(candidate.curve.wavelengths_nm), 1), by_deg))


def _turn_quarter(problem: InstrumentProblem, values: Values, places: tuple[str, ...]) -> Values:
    """The values with the azimuths of some places turned, each to its nearer side, and diattenuations reversed."""
    turned = dict(values)
    reversed_too = {f"{place.rpartition('.')[0]}.diattenuation" for place in places}
    for candidate, value in values.items():
        if candidate.place in places:
            by = -90.0 if _mean(candidate, value) > 0 else 90.0
            turned[candidate] = _turn(candidate, value, by)
        elif candidate.place in reversed_too and candidate.curve is None:
            turned[candidate] = -value - 2 * number(problem.model.value_of(candidate.place) or 0.0)
    return turned


def _distance(values: Values, places: Collection[str]) -> float:
    """Rms of some azimuths over those of the instrument file, degrees."""
    each = [_mean(c, v) for c, v in values.items() if c.place in places and _is_azimuth(c)]
    return float(np.sqrt(np.mean(np.square(each)))) if each else 0.0


def _excess(problem: InstrumentProblem, values: Values) -> float:
    space = Space(tuple(values))
    sums = problem.sums(space, space.vector(values), derivatives=False)
    return float(sums.excess.sum() + sums.freedom.sum())


def first_values(problem: InstrumentProblem, base: Space, pool: Sequence[Candidate], say: Say) -> Values:
    """Values to begin with, of the nominal values and of what else was found beside them."""
    fit = minimize(problem, base, np.zeros(base.size))
    if fit.rms < FAR_OFF or not any(c.effect.is_nominal for c in base.candidates):
        return base.split(fit.values)
    say("far off: searching from many starts")
    if len(set(problem.wavelengths_nm)) > 1:
        estimates = along_wavelengths(problem, base, say)
        space = Space(tuple(estimates))
        sums = problem.sums(space, space.vector(estimates), derivatives=False)
        return estimates if sums.excess.sum() < fit.excess else base.split(fit.values)
    # Nominal values are not found beside a source or channels that are as far off.
    free = [c for c in pool if c.effect.of_channels or (c.effect.of_source and c.effect.per_state)]
    wide = Space((*base.candidates, *free))
    return wide.split(best_of_starts(problem, wide, np.append(fit.values, np.zeros(wide.size - base.size))).values)


def best_of_starts(
    problem: InstrumentProblem, space: Space, begin: Array | None = None, free: BoolArray | None = None
) -> Fit:
    """The best fit from `begin` (K,) and, as long as that is far off, from many places about zero.

    `free` (K,) : what is fitted.
    """
    random = np.random.default_rng(0)
    best = minimize(problem, space, space.vector({}) if begin is None else begin, free=free)
    for k in range(STARTS):
        if best.rms < FAR_OFF:
            break
        # In every second start the plates are near what is declared; in the others a retardance may be any.
        point = random.uniform(-1, 1, space.size) * _widths(space, 180.0 if k % 2 else NOMINAL_DEG)
        best = min(best, minimize(problem, space, point, expansions=0, free=free), key=lambda fit: fit.excess)
    return best


def _widths(space: Space, retardance: float) -> Array:
    """Half widths (K,), degrees, of the starts, that of retardances given."""

    def width(candidate: Candidate) -> float:
        if not _anywhere(candidate):
            return 0.0
        # Azimuths come round again after half a turn.
        return 90.0 if candidate.place.endswith("azimuth_deg") else retardance

    return np.concatenate([np.zeros(0), *(np.full(c.size, width(c)) for c in space.candidates)])


def _anywhere(candidate: Candidate) -> bool:
    """A nominal value that may be far off: no window, no diattenuation."""
    return candidate.effect.is_nominal and candidate.parameters[0].typical >= NOMINAL_DEG


def along_wavelengths(problem: InstrumentProblem, base: Space, say: Say) -> Values:
    """One wavelength from many starts, each other one from the values of its neighbour, then all together."""
    wavelengths = sorted(set(problem.wavelengths_nm))
    space = Space((*base.candidates, *(c for c in problem.pool() if c.effect.of_channels)))
    problems, fits = [problem.at(w) for w in wavelengths], []
    for first in (len(wavelengths) // 2, 0, len(wavelengths) - 1):
        solutions: dict[int, Values] = {}
        for k in sorted(range(len(wavelengths)), key=lambda k: abs(k - first)):
            neighbour = solutions.get(k - 1 if k > first else k + 1)
            solutions[k] = _at_one(problems[k], space.acting(0, wavelengths[k]).space, neighbour)
        fits.append(minimize(problem, space, _join(space, [solutions[k] for k in sorted(solutions)])))
        say(f"beginning at {wavelengths[first]:g} nm: {100 * fits[-1].rms:.3g} %")
        if fits[-1].rms < FAR_OFF:
            break
    else:
        say("no mounts fit all wavelengths: were they homed anew in between? Then give each run by itself")
    return space.split(min(fits, key=lambda fit: fit.excess).values)


def _at_one(problem: InstrumentProblem, space: Space, neighbour: Values | None) -> Values:
    """Nominal values and gains of the channels at one wavelength, windows and diattenuations left as they are.

    From many starts, or from those of a neighbour: then what the wavelengths share is held.
    """
    large = np.array([_anywhere(c) or not c.effect.is_nominal for c in space.candidates for _ in c.parameters])
    if neighbour is None:
        return space.split(best_of_starts(problem, space, free=large).values)
    is_own = np.array([c.wavelength_nm is not None for c in space.candidates for _ in c.parameters])
    near = {c.short: v for c, v in neighbour.items()}
    values = np.concatenate([near[c.short] for c in space.candidates])
    return space.split(minimize(problem, space, values, free=is_own & large).values)


def _join(space: Space, solutions: Sequence[Values]) -> Array:
    """Values of the common vector, of those at each wavelength in ascending order."""
    parts = []
    for candidate in space.candidates:
        if candidate.curve is not None:
            at = [v for each in solutions for c, v in each.items() if c.short == candidate.short]
            parts.append(candidate.curve.through(np.stack(at)))
        else:
            parts.append(next(each[candidate] for each in solutions if candidate in each))
    return np.concatenate(parts)
