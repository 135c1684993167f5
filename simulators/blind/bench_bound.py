"""What can be reached without being told the set: benches drawn from the suite's own distribution, linearized.

The captures of a bench without faults give the curvature of the chi-square; faults are drawn as the suite draws them,
and their data from it. Three know more and more: `diagnose` (its own prior), one who knows how often each fault is
there and how large (its posterior mean has the least expected error that is possible), one who knows the set.
Leaves out: slips, fields, the bend of a drift, and what is not linear.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.captured.read_capture import read_capture
from processing.diagnosis.instrument.mueller_slopes import mueller_slopes
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.systematic import ELEMENTS
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.likely_set import likely_set
from processing.diagnosis.search.linearized import grouped, noise_of, quadratic
from processing.diagnosis.search.rules import CHANGES
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets
from processing.diagnosis.search.space import Space
from processing.diagnosis.search.stays import stay
from processing.instrument.effects.base import FieldEffect, Switch
from processing.instrument.model import InstrumentModel
from processing.storage.capture import Capture
from simulators.blind.lab_priors import PRIORS, draw_kinds
from simulators.blind.real_bench import FITTED, VALIDATION, make_bench

#: Two harmonics, of which a fault has one: once or twice a turn.
TWO_HARMONICS = ("rotation_eccentricity", "retarder_transmission")
#: A joint leads and lags by so much of what an eccentric scale does.
JOINT = 0.3
#: Kinds that have one sign.
POSITIVE = ("psg_extinction", "psa_extinction", "stray_light", "rotation_backlash")
#: Benches by which the chance of each kind is counted.
COUNTED = 2000
#: Widths about the geometric mean of the sizes, evenly likely: together nearly even in the logarithm over a decade.
TAUS = np.array([0.35, 0.6, 1.0, 1.7, 2.9])
#: 95 % of a normal distribution.
INTERVAL = 1.959964
#: Directions of M in which intervals are looked at.
DIRECTIONS = 15


@dataclass(frozen=True)
class Reached:
    """Error of M / m00 of the validation sample, rms, as it is and as expected; share of 95 % intervals that hold."""

    error: float
    told: float
    held: float


@dataclass(frozen=True)
class Linearized:
    """One bench without faults: its parameters, their chi-square, and M of the validation sample.

    Attributes
    ----------
    curvature : (K, K) of the chi-square, in typical sizes; noise : what its unit is.
    products : (K, K) mean square of M / m00 of the validation sample.
    """

    space: Space
    curvature: Array
    noise: Noise
    products: Array

    @classmethod
    def of(cls, folder: Path, seed: int, configs: Path, pixels: int) -> Linearized:
        """Make the bench of a seed, and linearize it."""
        truth = make_bench(folder, seed, configs, "none", pixels)
        declared = InstrumentModel.load(configs / "instruments" / truth.instrument).at(truth.wavelength_nm)
        fitted = _problem(declared, [folder / truth.name / f"{name}.h5" for name in FITTED])
        other = _problem(declared, [folder / "truth" / truth.name / f"{VALIDATION}_noisy.h5"])
        space = Space(tuple(c for c in fitted.pool() if _drawn(c)))
        start = np.zeros(space.size)
        sums = fitted.sums(space, start)
        form = quadratic(fitted, space, start, sums)
        lasts = [k for k, c in enumerate(space.candidates) if c.capture is None]
        index = np.concatenate([np.r_[space.slices[k]] for k in lasts])
        part = Space(tuple(space.candidates[k] for k in lasts))
        slopes, light = mueller_slopes(other, part, np.zeros(part.size))
        products = np.zeros((space.size, space.size))
        products[np.ix_(index, index)] = slopes.sum(axis=0) * np.outer(part.joined("typical"), part.joined("typical"))
        return cls(space, form.curvature, noise_of(fitted, sums), products / light / ELEMENTS)

    def draws(self, count: int, seed: int = 0) -> Iterator[tuple[Reached, Reached, Reached]]:
        """What the true set, the true distribution, and `diagnose` reach on benches drawn one after the other."""
        odds = {kind: _log_odds(kind) for kind in PRIORS}
        for k in range(count):
            random = np.random.default_rng([seed, k])
            truth, there = self._bench(random)
            form = self._data(truth, random)
            known, scale = self._known(form, odds)
            own = Sets(form, grouped(self.space, ())[1], self.noise)
            yield (
                self._reached(truth, *self._true_set(form, there)),
                self._reached(truth, *_averaged(known, scale)),
                self._reached(truth, *_averaged(own, np.ones(self.space.size))),
            )

    def _bench(self, random: np.random.Generator) -> tuple[Array, NDArray[np.bool_]]:
        """True values (K,) in typical sizes, and which of them belong to a fault of the bench."""
        truth, there = np.zeros(self.space.size), np.zeros(self.space.size, dtype=bool)
        for kind in draw_kinds(random):
            places = sorted({c.place for c in self.space.candidates if c.kind == kind})
            place = str(random.choice(places)) if places else ""
            for candidate, part in zip(self.space.candidates, self.space.slices, strict=True):
                if (candidate.kind, candidate.place) == (kind, place):
                    truth[part] = _values(kind, random, candidate.size) / candidate.typical
                    there[part] = True
        return truth, there

    def _data(self, truth: Array, random: np.random.Generator) -> Quadratic:
        """The chi-square of data with these values and the noise; at the truth it is what noise leaves."""
        size, vector = np.linalg.eigh(self.curvature)
        noise = (vector * np.sqrt(np.maximum(size, 0.0))) @ random.standard_normal(size.size)
        pull = self.curvature @ truth
        return Quadratic(float(truth @ pull + 2 * truth @ noise), -(pull + noise), self.curvature)

    def _true_set(self, form: Quadratic, there: NDArray[np.bool_]) -> tuple[Array, Array]:
        on = np.flatnonzero(there)
        width = np.concatenate([PRIORS[c.kind].rms / c.typical for c in self.space.candidates])[on]
        mean, covariance = np.zeros(there.size), np.zeros((there.size, there.size))
        own = np.linalg.inv(form.curvature[np.ix_(on, on)] + np.diag(width**-2.0))
        mean[on], covariance[np.ix_(on, on)] = -own @ form.gradient[on], own
        return mean, covariance

    def _known(self, form: Quadratic, odds: dict[str, float]) -> tuple[Sets, Array]:
        """Sets with the distribution that benches are drawn from, and the scale (K,) of their parameters."""
        scale, groups, chance = np.ones(self.space.size), [], []
        members, whole = grouped(self.space, ())
        for mine, group in zip(members, whole, strict=True):
            first = self.space.candidates[mine[0]]
            places = len({c.place for c in self.space.candidates if c.kind == first.kind})
            low, high = PRIORS[first.kind].sizes
            scale[group.index] = np.sqrt(low * high) / np.concatenate([self.space.candidates[k].typical for k in mine])
            parts = [group.index]
            if first.kind in TWO_HARMONICS:
                parts = [group.index[:2], group.index[2:]]
                scale[parts[1]] *= JOINT if first.kind == "rotation_eccentricity" else 1.0
            elif first.kind in ("source_drift", "retardance_drift"):
                parts = [group.index[:: first.size]]
            groups += [Group(part) for part in parts]
            several = places * (2 if first.kind in TWO_HARMONICS else 1)
            chance += [_divided(odds[first.kind], several)] * len(parts)
        scaled = Quadratic(form.excess, form.gradient * scale, form.curvature * np.outer(scale, scale))
        return DrawnSets(scaled, groups, self.noise, np.array(chance)), scale

    def _reached(self, truth: Array, mean: Array, covariance: Array) -> Reached:
        off = mean - truth
        vector = np.linalg.eigh(self.products)[1]
        along = vector[:, -DIRECTIONS:]
        spread = np.sqrt(np.maximum(np.einsum("ki,kl,li->i", along, covariance, along), 0.0))
        return Reached(
            float(np.sqrt(max(float(off @ self.products @ off), 0.0))),
            float(np.sqrt(max(float(np.sum(self.products * covariance)), 0.0))),
            float(np.mean(np.abs(off @ along) <= INTERVAL * spread)),
        )


class DrawnSets(Sets):
    """Sets whose groups are there each with its own log odds (G,), the others whatever they are."""

    def __init__(self, form: Quadratic, groups: Sequence[Group], noise: Noise, own: Array) -> None:
        super().__init__(form, groups, noise)
        self.own, self.taus = own, TAUS
        self.tau_weight = np.full((len(groups), TAUS.size), 1 / TAUS.size)

    def among(self, form: Quadratic, kept: NDArray[np.int64], groups: Sequence[Group], beside: int) -> DrawnSets:
        return DrawnSets(form, groups, self.noise, self.own[kept])

    def log_prior(self, there: NDArray[np.bool_]) -> float:
        return float(self.own[there].sum())

    def prior_odds(self, there: NDArray[np.bool_]) -> Array:
        return self.own


def _averaged(sets: Sets, scale: Array) -> tuple[Array, Array]:
    found = stay(sets, likely_set(sets), CHANGES)
    return found.mean * scale, found.covariance * np.outer(scale, scale)


def _problem(model: InstrumentModel, paths: Sequence[Path]) -> InstrumentProblem:
    data = []
    for path in paths:
        with Capture(path) as capture:
            data.append(read_capture(capture, model))
    return InstrumentProblem(model, data, folds=1)


def _drawn(candidate: Candidate) -> bool:
    return (
        candidate.kind in PRIORS
        and not candidate.state_chosen
        and not isinstance(candidate.effect, FieldEffect | Switch)
    )


def _values(kind: str, random: np.random.Generator, count: int) -> Array:
    """Values (count,) of one fault, in the unit of the effect."""
    low, high = PRIORS[kind].sizes
    size, phase = np.exp(random.uniform(np.log(low), np.log(high))), random.uniform(0, 2 * np.pi)
    circle = size * np.array([np.cos(phase), np.sin(phase)])
    out = np.zeros(count)
    if kind in ("source_flicker", "angle_per_state"):
        return np.asarray(size * random.standard_normal(count))
    if kind in TWO_HARMONICS:
        joint = bool(random.integers(2))
        out[2:] += circle * joint * (JOINT if kind == "rotation_eccentricity" else 1.0)
        out[:2] += circle * (not joint)
    elif kind == "beam_wander":
        out[:] = *circle, -circle[1], circle[0]
    elif kind in ("path_retardance", "image_drift", "retardance_over_turn"):
        out[:] = circle
    else:
        out[0] = size * (1 if kind in POSITIVE else random.choice([-1, 1]))
    return out


def _log_odds(kind: str) -> float:
    random = np.random.default_rng(0)
    chance = np.mean([kind in draw_kinds(random) for _ in range(COUNTED)])
    return float(np.log(chance / (1 - chance)))


def _divided(odds: float, places: int) -> float:
    """Log odds of a fault at one of so many places that are as likely."""
    chance = 1 / (1 + np.exp(-odds)) / places
    return float(np.log(chance / (1 - chance)))
