"""Whether "consistent" means anything: what of typical size would have been seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.problem import Problem
from processing.diagnosis.search.rules import NOMINAL_TAU, VISIBLE_FAULT
from processing.instrument.effects.base import CountsEffect, FieldEffect, Switch, ValuePerState


def information(found: Posterior) -> tuple[Array, NDArray[np.int64]]:
    """Information (K,) about each value at its typical size, and which values are nominal ones, which are free."""
    curvature, groups = found.sets.form.curvature, found.sets.groups
    told = np.diag(curvature).copy()
    always = np.concatenate([np.zeros(0, dtype=np.int64), *(g.index for g in groups if g.fixed_tau is not None)])
    if always.size:
        across = curvature[always]
        own = across[:, always] + np.eye(always.size) / NOMINAL_TAU**2
        told -= np.einsum("ij,ij->j", across, np.linalg.solve(own, across))
    return told, always


def would_be_seen(found: Posterior) -> tuple[Candidate, ...]:
    """Effects of optics, source or surface that at a typical size would stand out of the noise, or of what is left."""
    told, always = information(found)
    told /= found.samples.best.unit
    return tuple(
        candidate
        for candidate, part in zip(found.space.candidates, found.space.slices, strict=True)
        if not candidate.state_chosen
        and not isinstance(candidate.effect, CountsEffect | FieldEffect | Switch | ValuePerState)
        and not np.isin(part.start, always)
        and told[part].max() > VISIBLE_FAULT**2
    )


def wanted_for_evidence(problem: Problem) -> str:
    """What would make a statement possible where nothing of typical size would have been seen."""
    needed = "More light, more pixels, or states that differ more."
    if problem.noise_known:
        return needed
    return f"The noise: a column sigma in the states file, the detector's gain, or repeats of the states. {needed}"
