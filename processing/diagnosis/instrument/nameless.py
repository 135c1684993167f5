"""What no effect of the list is, asked in a cause's place: waves of a turning plate, a sample that turns, a lag.

A plate that is tilted in its mount has a retardance that changes twice a turn; bearings and windings make three or four
periods of it. With an unknown sample such a wave may look like something else (a transmission twice a turn, in the
light of a depolarizing sphere), and to the noise: then nothing in the data tells which of the two it is. A sample whose
stage drifts about the line of sight has an azimuth that drifts with it, which angles of single states can describe; so
can they a detector that reads a part of each frame with the next one, to first order an error of all angles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause
from processing.diagnosis.search.linearized import quadratic
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import SURE
from processing.diagnosis.search.sets import Group, Sets, State
from processing.diagnosis.search.space import Space
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OfOneCapture, OpticsEffect, moving_axes
from processing.instrument.model import InstrumentModel, Retarder

#: Periods a turn that no effect of the list has, of what a turning plate does.
PERIODS = {"retardance": (2, 3, 4), "azimuth": (3, 4), "transmission": (3, 4)}

#: Chi-square that has odds of 99 to 1.
STANDS_OUT = 2 * float(np.log(SURE / (1 - SURE)))


class WaveOfAPlate(OpticsEffect):
    """A wave of so many periods a turn of a retarder: in degrees, or relative transmission."""

    def __init__(self, what: str, periods: int) -> None:
        self.what, self.periods = what, periods
        self.kind = f"{what}_{periods}_a_turn"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        """Retarders that turn by more than half a turn: over less a wave is hardly anything but a slope."""
        axes = moving_axes(model, conditions)
        plates = (e for e in model.elements() if isinstance(e, Retarder) and e.axis in axes)
        return tuple(e.name for e in plates if np.ptp(e.ratio * conditions.angles_deg[e.axis or ""]) > 180)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        """Cosine and sine."""
        unit, size = ("1", 0.01) if self.what == "transmission" else ("degree", 0.5)
        return tuple(Parameter(n, unit, -20 * size, 20 * size, size) for n in ("cos", "sin"))

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        """Add the wave to what the plate does."""
        plate = next(e for e in model.elements() if e.name == place)
        t = self.periods * np.deg2rad(plate.ratio * changes.conditions.angles_deg[plate.axis or ""])
        wave = values[0] * np.cos(t) + values[1] * np.sin(t)
        if self.what == "transmission":
            changes.gain = changes.gain * (1 + wave)[:, None]
        else:
            target = changes.retardance_rad if self.what == "retardance" else changes.azimuth_rad
            target[place] = target[place] + np.deg2rad(wave)


class TurningSample(OpticsEffect, OfOneCapture):
    """The sample turns evenly about the line of sight; seen from it, everything else turns: degrees in all."""

    kind = "turning_sample"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        """The one sample."""
        return ("",)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        """From the first state to the last."""
        return (Parameter("turn", "degree", -10.0, 10.0, 0.5),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        """Turn every element."""
        for element in model.elements():
            turned = np.deg2rad(values[0]) * changes.conditions.elapsed
            changes.azimuth_rad[element.name] = changes.azimuth_rad[element.name] + turned


class ImageLag(OpticsEffect):
    """A share of the charge of a state is read with the next one."""

    kind = "image_lag"

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        """The one detector."""
        return ("",)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        """The share."""
        return (Parameter("share", "1", -0.1, 0.1, 0.005),)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        """Read it with the next one."""
        changes.lag += float(values[0])


class Nameless:
    """All of these beside the sets of a posterior, linearized about its values."""

    def __init__(self, problem: InstrumentProblem, found: Posterior) -> None:
        self._labels = [found.label(g) for g in range(len(found.members))]
        asked: dict[type[OpticsEffect], list[Candidate]] = {
            WaveOfAPlate: _waves(problem),
            TurningSample: _turning(problem),
            ImageLag: _once(ImageLag(), problem),
        }
        space = Space((*found.space.candidates, *(c for each in asked.values() for c in each)))
        values = np.append(found.values, np.zeros(space.size - found.space.size))
        form = quadratic(problem, space, values, problem.sums(space, values))
        own = [Group(np.r_[part].astype(np.int64)) for part in space.slices[len(found.space.candidates) :]]
        self._sets = Sets(form, (*found.sets.groups, *own), found.sets.noise)
        ends = np.cumsum([len(self._labels), *map(len, asked.values())]).tolist()
        self._groups = {effect: range(*pair) for effect, pair in zip(asked, pairwise(ends), strict=True)}
        best = found.samples.best
        self._state = State(np.append(best.tau, np.zeros(len(own))), best.unit)

    @classmethod
    def beside(cls, problem: InstrumentProblem, found: Posterior) -> Nameless | None:
        """None where these could not be told from others."""
        few = problem.holds_out_states or not problem.noise_known
        return None if few else cls(problem, found)

    def gains_over(self, cause: Cause) -> dict[type[OpticsEffect], float]:
        """Chi-square that the best of each kind explains in a cause's place beyond what that does.

        Every value of either costs two. Of those that stand out by themselves.
        """
        own = self._labels.index(cause.candidates[0])
        given = self._sets.given_others(self._sets.without(self._state, own))
        most = {kind: max((_explained(*given[g]) for g in of), default=0.0) for kind, of in self._groups.items()}
        return {kind: one - _explained(*given[own]) for kind, one in most.items() if one > STANDS_OUT}


def _once(effect: OpticsEffect, problem: InstrumentProblem) -> list[Candidate]:
    return [Candidate(effect, "", effect.parameters(problem.model, problem.captures[0].conditions, ""))]


def _turning(problem: InstrumentProblem) -> list[Candidate]:
    """One for each sample of unknown Mueller matrix: what is known is known as it stands."""
    unknown = [k for k, c in enumerate(problem.captures) if c.sample is None]
    return [replace(one, capture=k) for k in unknown for one in _once(TurningSample(), problem)]


def _waves(problem: InstrumentProblem) -> list[Candidate]:
    conditions = problem.captures[0].conditions
    return [
        Candidate(effect, place, effect.parameters(problem.model, conditions, place))
        for what, periods in PERIODS.items()
        for effect in (WaveOfAPlate(what, h) for h in periods)
        for place in effect.places(problem.model, conditions)
    ]


def _explained(curvature: Array, gradient: Array) -> float:
    """Chi-square that values explain, less two for each (Akaike's criterion)."""
    return float(gradient @ np.linalg.pinv(curvature, hermitian=True) @ gradient) - 2 * gradient.size
