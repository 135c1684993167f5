"""The posterior of all effects of an instrument at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.features import MARGIN
from processing.diagnosis.instrument.initial_values import first_values, nearest_branch
from processing.diagnosis.instrument.noise_of_light import scatter_prefers
from processing.diagnosis.instrument.photon_noise import exactly_undone
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.train import Train
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.correction import applied
from processing.diagnosis.search.fit import Fit, minimize, prior, score
from processing.diagnosis.search.likely_set import everything
from processing.diagnosis.search.posterior import Posterior, Say, fit_posterior
from processing.diagnosis.search.rules import EXACT, FAR_OFF, NEEDED, TAKES_PART
from processing.diagnosis.search.space import Space
from processing.instrument.elements import number
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import CaptureError


def validation_problem(problem: InstrumentProblem) -> InstrumentProblem:
    """The problem that is asked for held-out data: all of it where the parts have nothing left over."""
    sums = problem.sums(Space(()), np.zeros(0), derivatives=False)
    return problem if sums.freedom.min() > 0.5 and sums.count.min() > 0.5 else problem.undivided()


class WholeBench:
    """All effects of one problem.

    Attributes
    ----------
    whole : the problem with one set of unknowns for all states; `posterior` is found on it.
    start : values by candidate to begin with.
    """

    def __init__(self, problem: InstrumentProblem, say: Say, train: Train | None = None) -> None:
        self.problem, self.say = problem, say
        self.whole = problem.undivided() if problem.holds_out_states else problem
        self.base = Space((*problem.nominal(), *problem.levels()))
        self.pool = problem.pool()
        start = [self.whole.changes(k, Space(()), np.zeros(0)) for k in range(len(self.whole.captures))]
        unknowns = [int(np.linalg.matrix_rank(self.whole.columns(k, changes))) for k, changes in enumerate(start)]
        self._free = [c.values_per_pixel - n for c, n in zip(self.whole.captures, unknowns, strict=True)]
        if max(self._free) <= 0:
            most = max(c.values_per_pixel for c in self.whole.captures)
            raise CaptureError(
                f"{most} intensities of a pixel are no more than what is unknown of it: nothing is left over that "
                "could speak against the model. Take more states than the sample has unknowns, or a known sample."
            )
        branch = nearest_branch(self.whole, first_values(self.whole, self.base, self.pool, say))
        self.start, self.branch = branch.values, branch.message
        self._linearize_there()
        # Where one value of the train is far, each may be.
        self._far = dict(train.far) if train is not None else {}

    def _linearize_there(self) -> None:
        """Take the azimuths found for those of the model: a prior about far ones would widen with their distance."""
        azimuths = [c for c in self.start if c in self.base.candidates and c.place.endswith("azimuth_deg")]
        space = Space(tuple(azimuths))
        values = space.vector(self.start)

        def shifted(k: int, model: InstrumentModel) -> InstrumentModel:
            acting = space.acting(k, self.whole.wavelengths_nm[k])
            shifts = zip(acting.space.candidates, acting.of(values), strict=True)
            new: dict[str, dict[str, float]] = {}
            for candidate, shift in shifts:
                nominal = number(model.value_of(candidate.place) or 0.0)
                new.setdefault(candidate.place.rpartition(".")[0], {})["azimuth_deg"] = nominal + float(shift)
            return model.with_values(new)

        models = [shifted(k, model) for k, model in enumerate(self.whole.models)]
        same = self.problem is self.whole
        self.whole = self.whole.with_models(models)
        self.problem = self.whole if same else self.problem.with_models(models)
        self.start |= {c: np.zeros(c.size) for c in azimuths}

    @property
    def train_is_off(self) -> bool:
        """Nominal values, of one wavelength, none of which fit, whatever the source and the channels do beside them."""
        if not self.problem.nominal() or len(set(self.whole.wavelengths_nm)) > 1:
            return False
        # With one channel a value for each state takes up any mistake.
        beside = len(self.whole.model.channels) > 1
        start = {c: v for c, v in self.start.items() if beside or c in self.base.candidates}
        space = Space(tuple(start))
        values = space.vector(start)
        if not beside:
            values = minimize(self.whole, space, values).values
        return Fit(values, self.whole.sums(space, values, derivatives=False), 0.0).rms > FAR_OFF

    def run(self) -> Posterior:
        """The posterior; again with what varies over the image, and with the noise that the light found has."""
        plain = [c for c in self.pool if self._is_offered(c)]
        fixed = [*self.base.candidates, *self._clipped()]
        if self.whole.noise_known:
            start = Space(tuple(fixed))
            self.whole.level_noise(start, self._values_at_start(start))
        posterior = self._posterior([*fixed, *plain], fixed)
        if too_many := self.as_many_as_intensities(posterior, TAKES_PART):
            self.say(f"without {', '.join(c.label for c in too_many)}: it would be a value for each intensity")
            plain = [c for c in plain if c not in too_many]
            posterior = self._posterior([*fixed, *plain], fixed)
        posterior = self._without_refuted(posterior, fixed)
        fields = [c for c in self.pool if c.effect.varies_over_image]
        if fields and not self.whole.holds_out_states:
            # What the noise seemed to speak against may be right beside what varies over the image.
            with_fields = self._with_fields(posterior, fixed, plain, fields)
            posterior = posterior if with_fields is posterior else self._without_refuted(with_fields, fixed)
        # Behind a bent response the noise that counts should have is wrong by percents.
        space, values = applied(posterior, self.base)
        if self.whole.noise_known and self.whole.adopt_noise(space, values):
            if self.whole is not self.problem:
                self.problem.adopt_noise(space, values)
            self.say("the same with the noise that this light has")
            posterior = self._posterior(list(posterior.space.candidates), fixed, posterior)
        return posterior

    def _without_refuted(self, posterior: Posterior, fixed: Sequence[Candidate]) -> Posterior:
        """Without corrections of the counts whose light would scatter otherwise than the counts do.

        Unless nothing else explains the counts: then it is the noise that is not what is declared.
        """
        if not self.whole.noise_known:
            return posterior
        # Where one is gone another may stand in for it, and one that stood beside it may be right.
        while against := self._refuted_by_scatter(*applied(posterior, self.base)):
            worst = min(against, key=lambda c: against[c])
            self.say(f"the noise speaks against {worst.label}")
            trial = self._posterior([c for c in posterior.space.candidates if c != worst], fixed, posterior)
            if not trial.score > posterior.score + against[worst]:
                break
            posterior = trial
        return posterior

    def _refuted_by_scatter(self, space: Space, values: Array) -> dict[Candidate, float]:
        """Corrections of the counts that the noise speaks against, with the log likelihood that they lose."""
        undone = exactly_undone(space, values, pointwise=True)
        far = {c: v for c, v in undone.items() if np.any(np.abs(v) > EXACT * c.typical)}
        gains = {c: scatter_prefers(self.whole, space, values, {c: v}) for c, v in far.items()}
        return {c: gain for c, gain in gains.items() if gain < -NEEDED}

    def _is_offered(self, candidate: Candidate) -> bool:
        effect = candidate.effect
        if effect.varies_over_image or effect.is_switch:
            return False
        if candidate.price and not self.whole.noise_known:
            return False
        captures = self.whole.captures
        acting = [k for k, c in enumerate(captures) if candidate.acts(k, c.wavelength_nm)]
        acting_captures = [captures[k] for k in acting]
        if candidate.reaches_around:
            return all(min(c.signal.shape[2:]) > 2 * MARGIN + 2 for c in acting_captures)
        if candidate.is_pointwise:
            # With one number a pixel to test, a bend of the response and gains of the channels explain each other. So
            # do, with one ratio a state, a bend and what leaks through the channels, unless the noise tells the light.
            one_ratio = all(self.whole.ratios(k) == 1 for k in acting)
            return any(free > 1 for free in self._free) and (self.whole.noise_known or not one_ratio)
        if effect.per_state and not self.whole.noise_known:
            # A value for each intensity would be noise by another name.
            return len(self.whole.model.channels) > 1
        return True

    def as_many_as_intensities(self, posterior: Posterior, least: float) -> set[Candidate]:
        """Values for each state, of a probability above `least`, that with the others are one for each intensity.

        What is held out says nothing of them. Several channels see the same source: that is the last to be doubted.
        Many pixels with known noise test them all.
        """
        per_state = [
            posterior.space.candidates[m]
            for g, p in enumerate(posterior.samples.probability)
            if p > least
            for m in posterior.members[g]
            if posterior.space.candidates[m].effect.per_state
        ]
        valid: list[Candidate] = []
        for candidate in sorted(per_state, key=lambda c: not c.effect.of_source):
            if all(self._has_room(where, [*valid, candidate]) for where in map(self._captures_of, [*valid, candidate])):
                valid.append(candidate)
        return set(per_state) - set(valid)

    def _captures_of(self, candidate: Candidate) -> frozenset[int]:
        return frozenset(k for k, nm in enumerate(self.whole.wavelengths_nm) if candidate.acts(k, nm))

    def _has_room(self, captures: frozenset[int], values: Sequence[Candidate]) -> bool:
        """Whether what acts on these captures alone is fewer values for each state than their pixels tell.

        Angles that several captures share are told by all of them.
        """
        count = 0
        for data in (self.whole.captures[k] for k in captures):
            if self.whole.noise_known and data.usable.sum() > 1:
                return True
            count += len(self.whole.model.channels) - (self.whole.model.projects_source and data.sample is not None)
        return sum(self._captures_of(c) <= captures for c in values) < count

    def _posterior(
        self, candidates: Sequence[Candidate], fixed: Sequence[Candidate], old: Posterior | None = None
    ) -> Posterior:
        space = Space(tuple(candidates))
        starts = [self._values_at_start(space, old)]
        if self._far and old is None:
            starts.append(space.vector(self.start | self._far))
        return fit_posterior(self.whole, space, fixed, starts, say=self.say, far=self._far)

    def is_far(self, posterior: Posterior) -> bool:
        """Whether a value of the train is beyond the plausible."""
        train, values = Space(tuple(self._far)), posterior.space.split(posterior.values)
        return bool(train.is_far(train.vector(values)).any())

    def _values_at_start(self, space: Space, old: Posterior | None = None) -> Array:
        start = dict(self.start)
        if old is not None:
            start |= old.space.split(old.values)
        # Levels of the source may be noise, about which nothing is linearized (see `Samples.supported`).
        return space.vector({c: np.zeros(c.size) if c.effect.is_projected else v for c, v in start.items()})

    def _clipped(self) -> list[Candidate]:
        """The switch that leaves clipped pixels out, if they say something else than the others."""
        for candidate in self.pool:
            if candidate.effect.is_switch and any(c.clipped.any() for c in self.whole.captures):
                self.start[candidate] = np.ones(1)
                return [candidate]
        return []

    def least_unit(self, posterior: Posterior) -> float:
        """Unit of chi-square with every group there: what varies over the image may be what hides the others."""
        if not self.whole.noise_known:
            return posterior.samples.best.unit
        return min(posterior.samples.best.unit, posterior.sets.settled(everything(posterior.sets)).unit)

    def _with_fields(
        self, posterior: Posterior, fixed: Sequence[Candidate], plain: Sequence[Candidate], fields: Sequence[Candidate]
    ) -> Posterior:
        """The posterior of all with values that vary over the image, if they promise something beside the others."""
        space, values = applied(posterior, self.base)
        unit = self.least_unit(posterior)
        joint = Space((*space.candidates, *fields))
        sums = self.whole.sums(joint, np.append(values, np.zeros(joint.size - space.size)))
        parts = dict(joint.pairs)
        gains = {c: score(sums, space.size, parts[c], prior(joint))[0] / unit for c in fields}
        best = max(gains, key=lambda c: gains[c])
        if gains[best] < 2 * NEEDED:
            return posterior
        self.say(f"with {', '.join(c.label for c in fields)}")
        return self._posterior([*fixed, *plain, *fields], fixed)
