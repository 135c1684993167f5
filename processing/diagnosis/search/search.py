"""Which effects the model lacks: score all, fit the leaders, add while decisive, try to take each away again.

What is left over when a model is incomplete is the same in all pixels, not noise of each: a candidate must beat what it
could explain by chance in the few independent directions that such structure has (`directions`), not in all pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import stats

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit, HeldOut, held_out, minimize, prior, score
from processing.diagnosis.search.outcome import Found, Trial
from processing.diagnosis.search.problem import Problem
from processing.diagnosis.search.space import Space
from processing.instrument.effects.base import CountsEffect, FieldEffect, Switch, ValuePerState

#: Called with a line that says what is being done.
Say = Callable[[str], None]

#: Chi-square gain on held-out data from which on an effect is added: alone, and beside others, whose models are not
#: exact and leave something that it could take.
DECISIVE = 25.0
DECISIVE_BESIDE = 50.0
#: Two explanations closer than this in chi-square gain are not told apart.
CLOSE = 14.0
#: Nor closer than this share of what either explains: models are not exact to that.
ALIKE = 1e-3
#: Chance that one candidate explains as much of a structure that it has nothing to do with.
CHANCE = 1e-4
#: Standard deviations by which the counts may scatter less than a bent response says that they must.
IMPOSSIBLE = 6.0
MOST_EFFECTS = 12
#: Candidates that are scored together where every tile of the image has a matrix of its own, for the memory's sake.
TOGETHER = 24
LEADERS = 4
#: Relative rms residual above which nominal values are searched for from many starts.
FAR_OFF = 0.05
STARTS = 24


class Search:
    """The search over the effects in one problem."""

    decisive = DECISIVE

    def __init__(self, problem: Problem, say: Say) -> None:
        self.problem, self.say = problem, say
        self.base = Space(problem.nominal())
        self.pool = problem.pool()
        self.n0 = 1.0 if problem.noise_known else 0.0
        self._power: list[tuple[int, Array]] | None = None

    def run(self) -> Found:
        """Search; see the module."""
        base_fit = self._calibrated()
        found = self._greedy(base_fit, self.pool)
        if found.imitable:
            found = self._plainer(base_fit, found)
        if self.problem.adopt_noise(found.space, found.fit.values):
            # A bend of the response was taken away again, and what the noise was taken to be with it.
            found.before_fit, found.fit, found.before, found.after = self._again(
                found.before_fit, found.space, found.fit
            )
        self._sets(found)
        self._observability(found)
        return found

    def _greedy(self, base_fit: Fit, pool: Sequence[Candidate]) -> Found:
        """Add the best candidate of the pool while one is decisive, then take away what is not needed."""
        before = held_out(self.problem, self.base, base_fit)
        space, fit, out = self.base, base_fit, before
        ranking: list[Trial] = []
        alone: dict[Candidate, float] = {}
        imitable = False
        for _ in range(MOST_EFFECTS):
            trials = self._trials(space, fit, out, pool)
            if not ranking:
                ranking = trials
                alone = {t.candidate: (out.excess - t.out.excess) / max(out.excess, 1e-300) for t in trials}
            enough = self._enough(len(space.candidates) - len(self.base.candidates))
            trials = [t for t in trials if t.evidence >= enough and t.sound(out)]
            if not trials:
                break
            best = trials[0]
            if self.problem.adopt_noise(best.space, best.fit.values):
                base_fit, fit, before, out = self._again(base_fit, space, fit)
                best.fit = minimize(self.problem, best.space, best.fit.values)
                best.out = held_out(self.problem, best.space, best.fit)
                quiet = before.excess < -IMPOSSIBLE * self.noise_of(before)
                if quiet or self._evidence(out, best.out, best.space.size) < enough:
                    self.say(f"{best.candidate.label}: not with the noise that goes with it")
                    pool = [c for c in pool if c.family != best.candidate.family]
                    self.problem.adopt_noise(space, fit.values)
                    base_fit, fit, before, out = self._again(base_fit, space, fit)
                    continue
            imitable |= isinstance(best.candidate.effect, ValuePerState)
            self.say(f"{best.candidate.label}: {100 * out.rms:.4g} % -> {100 * best.out.rms:.4g} % on held-out data")
            space, fit, out = best.space, best.fit, best.out
        found = Found(self.base, before, base_fit, space, fit, out, ranking=ranking, alone=alone, imitable=imitable)
        self._prune(found)
        return found

    def _enough(self, beside: int) -> float:
        """Evidence that an effect needs beside so many others; without known noise, its unit is what they leave."""
        return max(self.decisive, DECISIVE_BESIDE if beside and self.n0 else 0.0)

    def _again(self, base_fit: Fit, space: Space, fit: Fit) -> tuple[Fit, Fit, HeldOut, HeldOut]:
        """Fits of the base and of the effects, and how well they predict, with the noise that holds now."""
        base_fit = minimize(self.problem, self.base, base_fit.values)
        fit = minimize(self.problem, space, fit.values)
        return base_fit, fit, held_out(self.problem, self.base, base_fit), held_out(self.problem, space, fit)

    def _plainer(self, base_fit: Fit, found: Found) -> Found:
        """The search without values for each state, if these add nothing to what it finds.

        So many values can imitate several plain effects at once, and are then the first to be added.
        """
        plain = [c for c in self.pool if not isinstance(c.effect, ValuePerState)]
        self.say("the same without values for each state")
        other = self._greedy(base_fit, plain)
        # Each must beat chance by itself: a few unrelated effects could also nibble at random values.
        if other.effects and all(other.chance[c] < CHANCE for c in other.effects):
            rest = self._trials(other.space, other.fit, other.after, self.pool)
            nothing_more = all(
                t.evidence < self.decisive for t in rest if isinstance(t.candidate.effect, ValuePerState)
            )
        else:
            nothing_more = False
        # The noise may be another one since: what was found first is fitted to the same.
        found.fit = minimize(self.problem, found.space, found.fit.values)
        found.after = held_out(self.problem, found.space, found.fit)
        worse = other.fit.excess - found.fit.excess - 2.0 * (found.space.size - other.space.size)
        if nothing_more and worse < self.decisive * self._unit(found):
            other.ranking, other.alone = found.ranking, found.alone
            return other
        return found

    def _unit(self, found: Found) -> float:
        """Chi-square of one direction of what is left: noise, and structure."""
        return self.n0 + self.structure(found.after, found.space.size)

    def _calibrated(self) -> Fit:
        space = self.base
        zero = np.zeros(space.size)
        fit = minimize(self.problem, space, zero)
        if space.size and _rms(fit) > FAR_OFF:
            self.say("nominal values are far off: searching from many starts")
            random = np.random.default_rng(0)
            width = np.array([45.0 if "azimuth" in c.place else 10.0 for c in space.candidates])
            for _ in range(STARTS):
                tried = minimize(self.problem, space, random.uniform(-2, 2, space.size) * width)
                if tried.excess < fit.excess:
                    fit = tried
        return fit

    def directions(self, excess: float) -> tuple[float, float]:
        """Independent directions of structure: those that weigh, and those that would show at this excess at all."""
        weighty, visible = 0.0, 0.0
        for free, power in self._powers():
            seen = max(excess, 0.0) * power / power.sum()
            weighty += free * power.sum() ** 2 / float(np.sum(power**2))
            visible += free * max(1.0, float(np.sum(seen / (1 + seen)))) if self.n0 else free
        return weighty, max(visible, weighty)

    def _powers(self) -> list[tuple[int, Array]]:
        if self._power is None:
            self._power = self.problem.powers()
        return self._power

    def _testable(self, candidate: Candidate, space: Space, excess: float) -> bool:
        if not isinstance(candidate.effect, ValuePerState):
            return True
        _, visible = self.directions(excess)
        return candidate.size + space.size < 0.75 * visible

    def _trials(
        self,
        space: Space,
        fit: Fit,
        out: HeldOut,
        pool: Sequence[Candidate],
        leaders: int = LEADERS,
        least: float = 0.0,
    ) -> list[Trial]:
        """The leading candidates, fitted jointly with the active ones and scored on held-out data, best first."""
        scored: dict[str, tuple[float, Candidate]] = {}
        weighty, _ = self.directions(out.excess)
        taken = {c.family for c in space.candidates}
        offered = [c for c in pool if c.family not in taken]
        offered = [c for c in offered if self._testable(c, space, out.excess)]
        for candidate, (gain, _) in self.scores(space, fit, offered).items():
            if gain < max(least, 0.5 * self.decisive * self.n0):
                continue
            rank = self._rank(fit.excess - gain, fit.excess, out, weighty, candidate.cost)
            if candidate.family not in scored or rank < scored[candidate.family][0]:
                scored[candidate.family] = (rank, candidate)
        order = [c for _, c in sorted(scored.values(), key=lambda item: item[0])]
        chosen = [c for c in order if not isinstance(c.effect, ValuePerState)][:leaders]
        # One step promises too little where there are many parameters: these are always fitted.
        chosen += [c for c in order if isinstance(c.effect, ValuePerState)]
        if _rms(fit) > FAR_OFF:
            chosen += [c for c in offered if c.starts and c not in chosen]
        trials = [self.trial(space, fit, out, c, weighty) for c in chosen]
        return sorted(trials, key=lambda t: t.rank)

    def scores(self, space: Space, fit: Fit, offered: Sequence[Candidate]) -> dict[Candidate, tuple[float, Array]]:
        """Promised gain of each candidate and the information about it, all from one pass over the data."""
        out: dict[Candidate, tuple[float, Array]] = {}
        tiled = [c for c in (*space.candidates, *offered) if isinstance(c.effect, FieldEffect)]
        plain = [c for c in offered if not isinstance(c.effect, FieldEffect) and not isinstance(c.effect, Switch)]
        counts = [c for c in plain if isinstance(c.effect, CountsEffect)]
        groups = [counts, [c for c in plain if c not in counts]]
        if any(c in tiled for c in space.candidates):
            # Every tile has its own matrix then: a part of the candidates at a time.
            groups = [groups[1][k : k + TOGETHER] for k in range(0, len(groups[1]), TOGETHER)] + [[c] for c in counts]
        groups += [[c] for c in offered if isinstance(c.effect, FieldEffect)]
        for group in groups:
            both = Space((*space.candidates, *group))
            values = np.concatenate([fit.values, np.zeros(both.size - space.size)])
            sums = self.problem.sums(both, values)
            weak = prior(both)
            for candidate, part in zip(group, both.slices[len(space.candidates) :], strict=True):
                out[candidate] = score(sums, space.size, part, weak)
        for candidate in offered:
            if isinstance(candidate.effect, Switch):
                out[candidate] = (self._clipped_excess(space, fit), np.zeros((1, 1)))
        return out

    def _clipped_excess(self, space: Space, fit: Fit) -> float:
        clipped = next(c for c in self.pool if isinstance(c.effect, Switch))
        both = Space((*space.candidates, clipped))
        with_all = self.problem.sums(both, np.append(fit.values, 0.0), derivatives=False).excess.sum()
        without = self.problem.sums(both, np.append(fit.values, 1.0), derivatives=False).excess.sum()
        return float(with_all - without)

    def trial(self, space: Space, fit: Fit, out: HeldOut, candidate: Candidate, weighty: float) -> Trial:
        """One candidate fitted with the active ones, from all its starts, and scored on held-out data."""
        both = Space((*space.candidates, candidate))
        best: Fit | None = None
        for start in (np.zeros(candidate.size), *candidate.starts):
            first = np.ones(1) if isinstance(candidate.effect, Switch) else start
            tried = minimize(self.problem, both, np.concatenate([fit.values, first]), expansions=0)
            if best is None or tried.excess < best.excess:
                best = tried
        if best is None:
            raise ValueError("a candidate needs at least one start")
        if fit.excess - best.excess > 0.5 * self.decisive * self.n0:
            # To expand anew costs a pass over all pixels; what explains nothing is not worth it.
            best = minimize(self.problem, both, best.values)
        held = held_out(self.problem, both, best)
        evidence = self._evidence(out, held, both.size)
        rank = self._rank(held.excess, out.excess, out, weighty, candidate.cost)
        return Trial(candidate, both, best, held, evidence, rank)

    def _rank(self, left: float, before: float, out: HeldOut, weighty: float, cost: float) -> float:
        """Bayesian information criterion over the directions of structure, not over the pixels; the least is best."""
        if self.n0 and left < 3 * self.noise_of(out):
            # Nothing is left beyond noise: ahead of all that leave structure, with noise as the measure.
            return float(-1e6 + left + cost * np.log(weighty))
        floor = self.n0 * weighty
        ratio = (max(left, 0.0) + floor + 1e-9) / (max(before, 0.0) + floor + 1e-9)
        return float(weighty * np.log(ratio) + cost * np.log(weighty))

    def _evidence(self, before: HeldOut, after: HeldOut, parameters: int, scaled: bool = False) -> float:
        """Chi-square gain on held-out data, in units of the noise; `scaled`, of the structure left as well."""
        gain = before.excess - after.excess
        if self.n0 and not scaled:
            return gain
        return gain / (self.n0 + self.structure(after, parameters))

    def noise_of(self, out: HeldOut) -> float:
        """Standard deviation of the excess if there is nothing but noise."""
        return float(np.sqrt(2 * out.freedom * self.problem.spread))

    def structure(self, after: HeldOut, parameters: int) -> float:
        """Chi-square for each direction of structure that is left beyond two standard deviations of the noise."""
        excess = after.excess - self.n0 * 2 * self.noise_of(after)
        weighty, _ = self.directions(excess)
        return float(max(excess, 0.0) / max(weighty - parameters, 1.0))

    def _prune(self, found: Found) -> None:
        """Take away, weakest first, what is not decisive beside what the rest leaves unexplained."""
        while found.effects:
            weakest, least = None, np.inf
            for candidate in found.effects:
                rest = Space(tuple(c for c in found.space.candidates if c != candidate))
                start = _without(found.space, found.fit.values, candidate)
                fit = minimize(self.problem, rest, start)
                out = held_out(self.problem, rest, fit)
                evidence = self._evidence(out, found.after, found.space.size, scaled=True)
                found.evidence[candidate] = evidence
                found.gain[candidate] = out.excess - found.after.excess
                found.chance[candidate] = self._chance(out, found.after, candidate.size, found.space.size)
                if evidence < least:
                    weakest, least, kept = candidate, evidence, (rest, fit, out)
            if weakest is None or least >= self._enough(len(found.effects) - 1):
                return
            self.say(f"{weakest.label} is not needed")
            found.space, found.fit, found.after = kept

    def _chance(self, before: HeldOut, after: HeldOut, size: int, parameters: int) -> float:
        """Chance that an unrelated candidate explains as much (F test over the directions of structure)."""
        weighty, _ = self.directions(max(after.excess, 0.0))
        free = max(weighty - parameters, 1.0)
        left = self.n0 + self.structure(after, parameters)
        ratio = (before.excess - after.excess) / size / left
        return float(stats.f.sf(ratio, size, free)) if ratio > 0 else 1.0

    def _sets(self, found: Found) -> None:
        """For every effect, all others that would do as well in its place; a simpler one of them replaces it."""
        for _ in range(MOST_EFFECTS):
            better = None
            for candidate in found.effects:
                rest = Space(tuple(c for c in found.space.candidates if c != candidate))
                fit = minimize(self.problem, rest, _without(found.space, found.fit.values, candidate))
                out = held_out(self.problem, rest, fit)
                needed = 0.7 * max(fit.excess - found.fit.excess, 0.0)
                others = [c for c in self.pool if c != candidate]
                trials = self._trials(rest, fit, out, others, leaders=6, least=needed)
                unit = self._unit(found)
                weighty, _ = self.directions(found.after.excess)
                close = []
                for trial in trials:
                    worse = self._worse(trial, candidate, found) / unit
                    simpler = (candidate.cost - trial.candidate.cost) * float(np.log(weighty))
                    alike = max(CLOSE, ALIKE * (out.excess - found.after.excess) / unit)
                    if worse < alike and trial.candidate.family != candidate.family:
                        close.append(trial.candidate)
                    if (
                        trial.sound(found.after)
                        and worse < simpler - 2
                        and (better is None or worse - simpler < better[0])
                    ):
                        better = (worse - simpler, candidate, trial)
                found.sets[candidate] = tuple(close)
            if better is None:
                return
            _, old, trial = better
            self.say(f"{trial.candidate.label} does as well as {old.label}, and is simpler")
            found.space, found.fit, found.after = trial.space, trial.fit, trial.out
            found.sets.clear()
            self._prune(found)

    def _worse(self, trial: Trial, candidate: Candidate, found: Found) -> float:
        """By how much another candidate does worse in the place of one that was found, in chi-square.

        On held-out data; or on all data, each further value at a cost of 2 (what it costs on the other half), if that
        is less: values that the data do not determine can run away on one half without being wrong.
        """
        more = max(trial.candidate.size - candidate.size, 0)
        return min(trial.out.excess - found.after.excess, trial.fit.excess - found.fit.excess + 2.0 * more)

    def _observability(self, found: Found) -> None:
        """Information about every candidate that the nominal values leave."""
        offered = [c for c in self.pool if not isinstance(c.effect, Switch)]
        testable = [c for c in offered if self._testable(c, found.base, max(found.before.excess, 0.0))]
        untestable = [c for c in offered if c not in testable]
        found.information = {c: info for c, (_, info) in self.scores(found.base, found.before_fit, testable).items()}
        found.untestable = tuple(untestable)


def _without(space: Space, values: Array, candidate: Candidate) -> Array:
    parts = [values[s] for c, s in zip(space.candidates, space.slices, strict=True) if c != candidate]
    return np.concatenate([np.zeros(0), *parts])


def _rms(fit: Fit) -> float:
    return float(np.sqrt(fit.sums.square.sum() / max(fit.sums.count.sum(), 1.0)))
