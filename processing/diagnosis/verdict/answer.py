"""The parts of an answer as they are stored: causes, correction, and what cannot be seen."""

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause, Names, answer_of, information, significance, wanted_for_evidence
from processing.diagnosis.search.decision import Judgement, held_out_check, refusal
from processing.diagnosis.search.fit import HeldOut, Solution
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.result import (
    BeyondNoise,
    CaptureReport,
    Check,
    Combination,
    Correction,
    Error,
    FoundEffect,
    MuellerError,
    Ranked,
    Unexplained,
)
from processing.diagnosis.search.rules import MOST_RANKED, NEEDED, SLACK, SMALL
from processing.diagnosis.search.space import Problem, Space
from processing.instrument.model import AppliedEffect, EffectParameter, SystematicError

#: [correlation] From which on two values are told together.
TOGETHER = 0.9
#: [1] Ratio of the largest to the least error among the directions of values that are told together.
OPEN = 5.0


def ties(values: Array, covariance: Array, typical: Array, told: Sequence[tuple[str, str]]) -> Iterator[Combination]:
    """Groups of values (K,) that are known together much better than each by itself, of their covariance (K, K).

    `told` : name and unit of each.
    """
    error = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    alike = np.abs(covariance / np.outer(error, error)) > TOGETHER
    count, group = connected_components(alike, directed=False)
    for k in range(count):
        index = np.flatnonzero(group == k)
        if index.size < 2:
            continue
        size, vector = np.linalg.eigh(covariance[np.ix_(index, index)] / np.outer(typical[index], typical[index]))
        if size[-1] < OPEN**2 * max(size[0], 0.0):
            continue
        weights = vector[:, 0] / typical[index]
        largest = int(np.argmax(np.abs(weights * error[index])))
        weights = weights / weights[largest]
        names, open_by = [told[i][0] for i in index.tolist()], vector[:, -1] * np.sqrt(size[-1]) * typical[index]
        yield Combination(
            weights=dict(zip(names, weights.tolist(), strict=True)),
            value=float(weights @ values[index]),
            stderr=float(np.sqrt(max(weights @ covariance[np.ix_(index, index)] @ weights, 0.0))),
            unit=told[int(index[largest])][1],
            open_by=dict(zip(names, open_by.tolist(), strict=True)),
        )


def combinations(posterior: Posterior, solved: Solution) -> tuple[Combination, ...]:
    """Combinations of the values of a correction that are only known together."""
    effects = set(solved.effects)
    at: list[int] = []
    told: list[tuple[str, str]] = []
    for candidate, part in posterior.space.pairs:
        if candidate in effects and not candidate.effect.per_state:
            at += range(part.start, part.stop)
            single = candidate.size == 1
            told += [
                (candidate.label if single else f"{candidate.label} {p.name}", p.unit) for p in candidate.parameters
            ]
    typical = posterior.space.joined("typical")[at]
    return tuple(ties(posterior.values[at], posterior.covariance[np.ix_(at, at)], typical, told))


def error(problem: Problem, solved: Solution, held_out: HeldOut, k: int | None = None) -> Error:
    """A residual as it is told, of one capture `k` or of all, in the unit of the counts as they were taken.

    Counts that a correction bends have another noise, so of known noise the residual is a multiple of it.
    """
    noise, rms, beyond = floor(problem, solved, k), 100 * held_out.rms, None
    if noise is not None:
        rms = noise * float(np.sqrt(held_out.chi2_reduced))
        beyond = BeyondNoise.of(held_out.excess, held_out.freedom, noise)
    return Error(rms_percent=rms, chi2_reduced=held_out.chi2_reduced, held_out=problem.held_out, beyond_noise=beyond)


def floor(problem: Problem, solved: Solution, k: int | None = None) -> float | None:
    """Rms noise over the mean signal, percent, of the counts as they were taken: of one capture or of all."""
    if not problem.noise_known:
        return None
    return 100 * problem.noise_floor(solved.base, solved.before_fit.values, k)


def held_out_without(problem: Problem, solved: Solution, effects: Collection[Candidate]) -> HeldOut:
    """Residual of the correction without some of its effects; for each degree of freedom, as after it."""
    values = solved.fit.values.copy()
    for candidate, part in solved.space.pairs:
        if candidate in effects:
            values[part] = 0.0
    sums = problem.sums(solved.space, values, derivatives=False)
    # Fits to other folds may end elsewhere than the fit to all, whose difference this is.
    after, square = solved.after, float(sums.square.sum() - solved.fit.sums.square.sum())
    excess = after.excess + float(sums.excess.sum()) - solved.fit.excess
    return HeldOut(excess, after.freedom, max(after.square + square, 0.0), after.count)


def effects_of_cause(
    problem: Problem, solved: Solution, cause: Cause, doubt: str | None, *, not_applied: str | None
) -> list[FoundEffect]:
    """Effects of a cause for the answer, given a reason to doubt it; one for each capture in which it shows."""
    without = held_out_without(problem, solved, (*cause.candidates, *cause.alternatives))
    if not any(c in solved.space.candidates for c in (*cause.candidates, *cause.alternatives)):
        not_applied = not_applied or doubt or "it is not needed in addition to the other causes"
    answer, probability = answer_of(cause, doubt)
    effects = []
    # Of one with values of its own in every capture, those captures are told in which it shows.
    each = [
        at
        for entry in zip(cause.candidates, cause.values, cause.covariance, strict=True)
        for at in entry[0].by_wavelength(*entry[1:])
    ]
    sizes = [significance(values, covariance) for _, values, covariance in each]
    for (candidate, values, covariance), size in zip(each, sizes, strict=True):
        if size < min(1.0, max(sizes)):
            continue
        effects.append(
            FoundEffect(
                kind=candidate.kind,
                element=candidate.place or None,
                parameters=candidate.stored(values, np.sqrt(np.diag(covariance))),
                evidence=2 * cause.log_odds,
                indistinguishable_from=tuple(dict.fromkeys(c.short for c in cause.alternatives)),
                scope=candidate.scope,
                capture=None if candidate.capture is None else problem.captures[candidate.capture].name,
                wavelength_nm=candidate.wavelength_nm,
                removal_chance=1 - probability,
                confident=doubt is None and cause.answer not in ("unknown", "unlisted"),
                probability=probability,
                answer=answer,
                residual_without=error(problem, solved, without),
                residual_with=error(problem, solved, solved.after),
                not_applied=not_applied,
            )
        )
    return effects


def effects_of_switches(problem: Problem, solved: Solution) -> list[FoundEffect]:
    """Effects that exclude pixels, because these contradict the others."""
    effects = []
    for candidate, part in solved.space.pairs:
        if candidate.effect.is_switch:
            value, never = solved.fit.values[part], np.zeros((1, 1))
            gain = held_out_without(problem, solved, (candidate,)).excess - solved.after.excess
            cause = Cause((candidate,), (value,), (never,), probability=1.0, log_odds=gain / 2, alternatives=())
            effects += effects_of_cause(problem, solved, cause, None, not_applied=None) if gain > 2 * NEEDED else []
    return effects


def _wavelength(problem: Problem, candidate: Candidate) -> float | None:
    """Wavelength at which the values hold; None for all of them."""
    several: set[float] = {c.wavelength_nm for c in problem.captures}
    effect = candidate.of_instrument
    if effect and problem.model.belongs_to.get(candidate.kind, effect.belongs_to) == "mechanics":
        return None
    if candidate.capture is not None:
        return float(problem.captures[candidate.capture].wavelength_nm)
    return several.pop() if len(several) == 1 else candidate.wavelength_nm


def ranking(posterior: Posterior, before: HeldOut, rms_percent: float) -> tuple[Ranked, ...]:
    """Groups by what each would explain alone of a residual `before`, which has this rms."""
    form, groups = posterior.sets.form, posterior.sets.groups
    total = max(before.excess + before.freedom, 1e-300)
    alone = []
    for k in np.flatnonzero(posterior.sets.free):
        g, h = form.gradient[groups[k].index], form.curvature[np.ix_(groups[k].index, groups[k].index)]
        alone.append((float(g @ np.linalg.solve(h + np.eye(g.size), g)), int(k)))
    return tuple(
        Ranked(
            candidate=posterior.label(k).label,
            evidence=round(gain, 1),
            rms_percent=rms_percent * float(np.sqrt(max(1 - gain / total, 0.0))),
            values=len(groups[k].index),
        )
        for gain, k in sorted(alone, reverse=True)[:MOST_RANKED]
    )


def unobservable(problem: Problem, posterior: Posterior) -> list[Candidate]:
    """Candidates about which the captures say nothing, the nominal values being free."""
    precision, always = information(posterior)
    unseen = []
    for candidate, part in posterior.space.pairs:
        if candidate.state_chosen or candidate.effect.is_switch or np.isin(part.start, always):
            continue
        least = np.full(candidate.size, SLACK**2)
        if candidate.reaches_around:
            # Noise alone has slopes too, from one pixel to the next, which a shift would change.
            alone = Space((candidate,))
            noise = np.diag(problem.noise_information(alone, np.zeros(alone.size))[0]) * candidate.typical**2
            least = np.maximum(least, SMALL * noise)
        if np.all(precision[part] < least):
            unseen.append(candidate)
    return unseen


def checks(problem: Problem, solved: Solution) -> tuple[Check, ...]:
    """Held-out residual before and after: if it gets worse, that is no explanation."""
    held_out = solved.before, solved.after
    figures = [held_out_check(*(error(problem, solved, part) for part in held_out))]
    for k, data in enumerate(problem.captures if len(problem.captures) > 1 else ()):
        # The sum decides; what became of each is told also where nothing is written.
        old, new = (error(problem, solved, part.of(k), k).rms_percent for part in held_out)
        name = f"rms on held-out data of {data.name} at {data.wavelength_nm:g} nm, percent"
        figures.append(Check(name=name, before=old, after=new, holds=True))
    return tuple(figures)


@dataclass(frozen=True)
class Answer:
    """A posterior with its correction, names and judgement; `switched` are causes that are on or off.

    `problem` is what the correction predicts.
    """

    problem: Problem
    posterior: Posterior
    solved: Solution
    names: Names
    judgement: Judgement
    switched: Sequence[FoundEffect] = ()

    @property
    def any_cause(self) -> bool:
        """Whether anything was found, with a name or without."""
        return self.judgement.named or bool(self.names.untold)

    @property
    def applied(self) -> Solution:
        """The correction that is applied."""
        return self.judgement.applied(self.solved, self.any_cause)

    def fields(
        self,
        *,
        recommended: Callable[[], str],
        descriptions: Sequence[str],
        captures: Sequence[CaptureReport],
        unseen: Sequence[Candidate],
        calibrated: dict[str, EffectParameter],
        lasts: bool,
        uncertain: tuple[SystematicError, MuellerError] | None = None,
    ) -> dict[str, Any]:
        """Fields of a `Diagnosis`.

        Parameters
        ----------
        recommended : says what to do next where something could be seen.
        descriptions : sentences about what is left over.
        unseen : what these captures cannot show.
        lasts : whether the correction may be used for later captures.
        uncertain : how wrong M may be still.
        """
        problem, solved, final, names = self.problem, self.solved, self.applied, self.names
        verdict, declared = self.judgement.verdict, error(problem, solved, solved.before)
        ranked = ranking(self.posterior, solved.before, declared.rms_percent)
        # What makes the residual worse is no cause, however well it fits.
        worse, refused = refusal(self.judgement.figures), self.judgement.refused
        tried = tuple(c.candidates[0].label for c in names.named)
        return {
            "verdict": verdict,
            "error_before": declared,
            "error_after": error(problem, final, final.after),
            "noise_floor_percent": floor(problem, final),
            "effects": (
                *(
                    e
                    for c in names.named
                    for e in effects_of_cause(problem, solved, c, worse or names.doubt.get(c), not_applied=refused)
                ),
                *self.switched,
            ),
            "unobservable": (
                *dict.fromkeys(c.short for c in unseen),
                *(f"{c.candidates[0].short} (as many values as the data have)" for c in names.untold),
            ),
            "recommendation": wanted_for_evidence(problem) if verdict == "undetermined" else recommended(),
            "unexplained": Unexplained(
                description=tuple(descriptions), tried=tried or tuple(r.candidate for r in ranked[: MOST_RANKED // 2])
            )
            if verdict in ("unexplained", "partly_explained")
            else None,
            "calibrated": calibrated,
            "ranking": ranked,
            "captures": tuple(captures),
            "instrument": problem.model.name,
            "wavelengths_nm": tuple(sorted({c.wavelength_nm for c in problem.captures})),
            "simulated": any(c.simulated for c in problem.captures),
            "correction": self._correction(lasts, uncertain),
        }

    def _correction(self, lasts: bool, uncertain: tuple[SystematicError, MuellerError] | None) -> Correction:
        """Content of a file: means, with the spread over the sets; for these captures alone unless it `lasts`."""
        posterior, solved, captures = self.posterior, self.solved, self.problem.captures
        part, candidates = dict(posterior.space.pairs), posterior.space.candidates
        chance = {candidates[m]: p for g, p in enumerate(posterior.samples.probability) for m in posterior.members[g]}
        effects = []
        for candidate, where in solved.space.pairs if self.any_cause else ():
            if candidate in solved.base.candidates:
                continue
            covariance = posterior.covariance[part[candidate], part[candidate]]
            for single, values, block in candidate.by_wavelength(solved.fit.values[where], covariance):
                effects.append(
                    AppliedEffect(
                        kind=single.kind,
                        element=single.place or None,
                        parameters=single.stored(values, np.sqrt(np.maximum(np.diag(block), 0.0))),
                        probability=float(chance[candidate]),
                        captures=tuple(c.name for k, c in enumerate(captures) if single.acts(k, c.wavelength_nm)),
                        scope=single.scope if lasts else "capture",
                        wavelength_nm=_wavelength(self.problem, single),
                    )
                )
        stored, mueller = uncertain or (None, None)
        return Correction(
            effects=tuple(effects),
            systematic=stored,
            mueller=mueller,
            combinations=combinations(posterior, solved) if self.any_cause else (),
            checks=self.judgement.checks,
            refused=self.judgement.refused,
        )
