"""A set of groups that explains the data down to their noise, where none seems worth its values.

What no set explains counts as noise of a few directions (`Noise`), and such noise is cheap: where eight causes together
leave nothing, three of them beside a large unit can be the likelier set, and each of the others gains little beside
them. Here every intensity counts in full. Structure would then be described by whatever comes nearest to it, so a set
is believed only if nothing but noise is left.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.descent import all_at_once, next_values
from processing.diagnosis.search.likely_set import climb, likely_set
from processing.diagnosis.search.linearized import noise_of, quadratic
from processing.diagnosis.search.rules import BENT, EXACT, MOSTLY, ROUNDS
from processing.diagnosis.search.sets import Group, Noise, Sets, State
from processing.diagnosis.search.space import Problem, Space


def down_to_noise(
    problem: Problem,
    space: Space,
    fixed: Sequence[Candidate],
    groups: Sequence[Group],
    *,
    start: Array,
    noise: Noise,
    unit: float,
) -> tuple[Array, Sets, State] | None:
    """Values (K,) about which it was linearized, the sets there and the likeliest; None if structure is left.

    Parameters
    ----------
    start : (K,) values to begin with.
    noise, unit : of chi-square where structure was left; every round has to leave less than `MOSTLY` of it, or `BENT`.
    """
    x, settled = all_at_once(problem, space, fixed, start, noise=noise, tau=EXACT), False
    for left in reversed(range(ROUNDS)):
        problem.relinearize(space, x)
        sums = problem.sums(space, x)
        form = quadratic(problem, space, x, sums)
        if not (np.isfinite(form.excess) and np.all(np.isfinite(form.curvature))):
            return None
        last, unit = unit, noise_of(problem, sums).unit(float(sums.excess.sum()))
        if unit > max(MOSTLY * last, BENT):
            return None
        full = Noise(True, max(float(sums.freedom.sum()), 1.0))
        sets = Sets(form, groups, full)
        state = likely_set(sets)
        if settled or not left:
            break
        x, settled = next_values(problem, space, sets, state, x=x)
    if unit > BENT:
        return None
    sets = Sets(form, groups, Noise(True, full.directions, floor=unit))
    return x, sets, climb(sets, state)
