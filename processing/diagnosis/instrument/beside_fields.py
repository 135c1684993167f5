"""How many values take part beside a map over the image, for which every tile has a matrix of its own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import BESIDE_FIELD


def likeliest_that_fit(problem: InstrumentProblem, found: Posterior, taken: Sequence[Candidate]) -> list[Candidate]:
    """The likeliest groups of a posterior whose slopes, beside those `taken`, fit into the memory for each capture."""
    room = [BESIDE_FIELD // slopes_of_a_value(problem, k) for k in range(len(problem.captures))]
    left = np.array(room) - _values(problem, taken)
    kept: list[Candidate] = []
    for group in np.argsort(-found.sets.conditional(found.samples.best).log_odds):
        mine = [found.space.candidates[m] for m in found.members[group]]
        needed = _values(problem, mine)
        if mine[0] not in taken and np.all(needed <= left):
            kept += mine
            left -= needed
    return kept


def slopes_of_a_value(problem: InstrumentProblem, k: int) -> int:
    """How many numbers the slopes of the rows of all tiles of a capture by one value are."""
    tiles, data = problem.moments[k].tiles, problem.captures[k]
    if tiles is None:
        raise ValueError("a capture that holds out states has no tiles")
    return tiles.x.size * data.values_per_pixel * (16 if data.sample is None else 1)


def _values(problem: InstrumentProblem, candidates: Sequence[Candidate]) -> NDArray[np.int64]:
    """How many values (captures,) of the candidates act on each capture."""
    acting = ([c.at(w).size for c in candidates if c.acts(k, w)] for k, w in enumerate(problem.wavelengths_nm))
    return np.array([sum(sizes) for sizes in acting], dtype=np.int64)
