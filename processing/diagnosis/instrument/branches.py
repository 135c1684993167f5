"""Turns of elements that no data can determine: of those that fit equally well, the one nearest to the nominal file.

An element turned by half a turn is the same. A retarder turned by a quarter turn has the opposite retardance, and where
all retarders have it, a sample without circular polarization (air, a mirror) looks the same: row and column 3 of every
later Mueller matrix then change their sign. The instrument file decides, whatever the search started from.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate, NominalValue
from processing.diagnosis.search.space import Space
from processing.instrument.elements import number

#: [of the residual] By which two branches may differ that are the same to the data.
ALIKE = 1e-3
#: [degree, fixed] Period of the azimuth of an element.
HALF_TURN = 180.0
#: [degree] Distances closer than this are the same.
TIE = 1e-6
#: [degree, fixed] Period of a retardance.
WHOLE = 360.0
#: [degree, fixed] After which a retarder has the opposite retardance, and a diattenuator the opposite diattenuation.
QUARTER_TURN = 90.0

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
    told: str | None


def nearest_branch(problem: InstrumentProblem, found: Mapping[Candidate, Array]) -> Branch:
    """The values found, on the branch whose azimuths are nearest to the instrument file."""
    values = _of_nominal_retardance(problem, found)
    values = {c: _within_half_a_turn(c, v) if _is_azimuth(c) else v for c, v in values.items()}
    places = sorted({c.place for c in values if _is_azimuth(c)})
    own = _excess(problem, values)
    branches: list[tuple[tuple[str, ...], Values]] = [((), values)]
    for count in range(1, len(places) + 1):
        for turned in combinations(places, count):
            other = _quarter_turned(problem, values, turned)
            if _excess(problem, other) <= own * (1 + ALIKE):
                branches.append((turned, other))
    branches.sort(key=lambda one: _distance(one[1], places))
    (turned, best), *others = branches
    if not others:
        return Branch(best, None)
    second, other = others[0]
    differ = sorted(set(turned) ^ set(second))
    return Branch(
        best,
        f"the captures fit as well with {' and '.join(name.rpartition('.')[0] for name in differ)} turned by 90 "
        "degrees, where row 3 and column 3 of M have the other sign. The instrument file decides: its azimuths are "
        f"{_distance(best, differ):.0f} degrees from those taken and {_distance(other, differ):.0f} from the others "
        "(rms)",
    )


def _of_nominal_retardance(problem: InstrumentProblem, found: Mapping[Candidate, Array]) -> Values:
    """The values with retardances nearest to the instrument file: that of d, -d and 360 - d, a quarter turn apart."""
    values = dict(found)
    azimuths = {c.place.rpartition(".")[0]: c for c in values if _is_azimuth(c)}
    for candidate, value in found.items():
        element, _, field = candidate.place.rpartition(".")
        if field != "retardance_deg" or candidate.curve is not None or not isinstance(candidate.effect, NominalValue):
            continue
        nominal = number(problem.model.value_of(candidate.place) or 0.0)
        same, opposite = (_near_zero(sign * (nominal + value[0]) - nominal) for sign in (1, -1))
        azimuth = azimuths.get(element)
        nearer = abs(same) - abs(opposite)
        # A half-wave plate has both at one distance: then the smaller retardance is taken, and the azimuth decides.
        turns = nearer > TIE or (nearer > -TIE and opposite < same)
        if turns and azimuth is not None and azimuth.wavelength_nm == candidate.wavelength_nm:
            values[azimuth] = _turned(azimuth, values[azimuth], QUARTER_TURN)
            same = opposite
        values[candidate] = np.array([same])
    return values


def _near_zero(retardance_deg: float) -> float:
    return float((retardance_deg + WHOLE / 2) % WHOLE - WHOLE / 2)


def _is_azimuth(candidate: Candidate) -> bool:
    return isinstance(candidate.effect, NominalValue) and candidate.effect.field == "azimuth_deg"


def _mean(candidate: Candidate, values: Array) -> float:
    """Azimuth over its nominal value, mean over the wavelengths of a curve."""
    if candidate.curve is None:
        return float(values[0])
    return float(np.mean(candidate.curve.basis @ values))


def _within_half_a_turn(candidate: Candidate, values: Array) -> Array:
    return _turned(candidate, values, -HALF_TURN * float(np.round(_mean(candidate, values) / HALF_TURN)))


def _turned(candidate: Candidate, values: Array, by_deg: float) -> Array:
    if candidate.curve is None or not by_deg:
        return values + by_deg
    return values + candidate.curve.through(np.full((len(candidate.curve.wavelengths_nm), 1), by_deg))


def _quarter_turned(problem: InstrumentProblem, values: Values, places: tuple[str, ...]) -> Values:
    """The values with the azimuths of some places turned, each to its nearer side, and diattenuations reversed."""
    out = dict(values)
    reversed_too = {f"{place.rpartition('.')[0]}.diattenuation" for place in places}
    for candidate, value in values.items():
        if candidate.place in places:
            by = -QUARTER_TURN if _mean(candidate, value) > 0 else QUARTER_TURN
            out[candidate] = _turned(candidate, value, by)
        elif candidate.place in reversed_too and candidate.curve is None:
            out[candidate] = -value - 2 * number(problem.model.value_of(candidate.place) or 0.0)
    return out


def _distance(values: Values, places: Collection[str]) -> float:
    """Rms of some azimuths over those of the instrument file, degrees."""
    each = [_mean(c, v) for c, v in values.items() if c.place in places and _is_azimuth(c)]
    return float(np.sqrt(np.mean(np.square(each)))) if each else 0.0


def _excess(problem: InstrumentProblem, values: Values) -> float:
    space = Space(tuple(values))
    sums = problem.sums(space, np.concatenate([np.zeros(0), *values.values()]), derivatives=False)
    return float(sums.excess.sum() + sums.freedom.sum())
