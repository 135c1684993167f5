"""A correction without its least certain effects, where M may get worse with them and does not without."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.guard import predicted_changes
from processing.diagnosis.instrument.outcome import Outcome
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import CHANCE_WORSE, SURE
from processing.diagnosis.search.solution import Solution


def in_part(used: Outcome) -> Outcome:
    """The correction, or what remains of it without the effects that make M worse by chance.

    The least certain effects are left out one after the other. The others take the values that they have without.
    """
    found, tried = used.found, used
    without: list[Candidate] = []
    chance = {found.space.candidates[m]: p for g, p in enumerate(found.samples.probability) for m in found.members[g]}
    while predicted_changes(tried.asked, found, tried.solved)[0].chance_worse > CHANCE_WORSE:
        uncertain = [c for c in tried.solved.effects if chance[c] < SURE]
        if not uncertain or len(uncertain) == len(tried.solved.effects):
            return used
        least = min(chance[c] for c in uncertain)
        dropped = [c for c in uncertain if chance[c] == least]
        without += dropped
        tried = used.corrected_by(_values_without(found, dropped, tried.solved), without)
    return tried


def _values_without(found: Posterior, dropped: Sequence[Candidate], solved: Solution) -> Array:
    """Values (K,) of a correction, as their covariance has them where those of some effects are zero."""
    values, part = found.values.copy(), dict(zip(found.space.candidates, found.space.slices, strict=True))
    for candidate, own in zip(solved.space.candidates, solved.space.slices, strict=True):
        values[part[candidate]] = solved.fit.values[own]
    gone = np.concatenate([np.r_[part[c]] for c in dropped])
    across = found.covariance[:, gone]
    values -= across @ np.linalg.pinv(across[gone], hermitian=True) @ values[gone]
    values[gone] = 0.0
    return values
