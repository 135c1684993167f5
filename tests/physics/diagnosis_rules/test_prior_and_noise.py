"""Constants of the prior and of the noise."""

from types import SimpleNamespace as Some

import numpy as np
from rule_decisions import QUIET, Patch, bench, decides, made, one

from processing.diagnosis.instrument import systematic, whole_bench
from processing.diagnosis.search import dispersion, likely_set, posterior
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets, State
from processing.diagnosis.search.space import Space, Sums
from processing.effect import Parameter


@decides
def test_tau(m: Patch) -> bool:
    s, state = one(1.0, -5.0), State(np.ones(1))
    likely_set.retune(s, state)
    return abs(s.fitted(state).mean[0] - 4.5) < 0.05


@decides
def test_tau_weight(m: Patch) -> bool:
    return abs(one(0.0, 0.0).conditional(State(np.zeros(1))).log_odds[0] - np.log(1 / 0.5)) < 0.05


@decides
def test_tau_weight_of_many(m: Patch) -> bool:
    s = Sets(Quadratic(0.0, np.zeros(9), np.zeros((9, 9))), [Group(np.arange(9))], QUIET)
    return abs(s.conditional(State(np.zeros(1))).log_odds[0] - np.log(1 / 0.5)) < 0.05


@decides
def test_many(m: Patch) -> bool:
    form = Quadratic(0.0, np.zeros(17), np.zeros((17, 17)))
    return Sets(form, [Group(np.arange(9)), Group(np.arange(9, 17))], QUIET).many.tolist() == [True, False]


@decides
def test_few_causes(m: Patch) -> bool:
    return abs(one(0.0, 0.0, groups=10).conditional(State(np.zeros(10))).log_odds[0] + np.log(14)) < 0.02


@decides
def test_nominal_tau(m: Patch) -> bool:
    candidate = made()
    (group,) = posterior.grouped(Space((candidate,)), [candidate])[1]
    s = Sets(Quadratic(0.0, np.array([-1.0, 0.0]), 0.01 * np.eye(2)), [group, Group(np.array([1]))], QUIET)
    return abs(s.fitted(s.empty()).mean[0] - 50) < 5


def principal_curves(last_nm: float) -> np.ndarray:
    return dispersion.curve(np.geomspace(500.0, last_nm, 8), (Parameter("p", "1", -1.0, 1.0, 1.0),)).basis


@decides
def test_smooth(m: Patch) -> bool:
    basis = principal_curves(500 * np.exp(0.3))
    return abs(basis[0] @ basis[-1] - np.exp(-0.5)) < 0.02


@decides
def test_flat(m: Patch) -> bool:
    return [principal_curves(last).shape[1] for last in (945.0, 960.0)] == [6, 7]


@decides
def test_unseen(m: Patch) -> bool:
    found = Some(space=Space((made(),)), sets=one(0.0, 0.0), samples=Some(best=State(np.zeros(1)), probability=[0.0]))
    return abs(systematic._unseen(found)[0, 0] - 0.3) < 0.01


def noise(known: bool, excess: float, freedom: float) -> Noise:
    sums = Sums.empty(1, 0)
    sums.excess[0], sums.freedom[0], sums.square[0], sums.count[0] = excess, freedom, 1.0, 1.0
    return posterior.noise_of(Some(noise_known=known, spread=1.0, powers=lambda: [(10, np.ones(1))]), sums)


@decides
def test_slack(m: Patch) -> bool:
    n = noise(True, 0.0, 50.0)
    return n.unit(18.0) == 1.0 < n.unit(22.0)


@decides
def test_noise_level(m: Patch) -> bool:
    # Of two million intensities chance alone would forgive an excess of 4000.
    n = noise(True, 0.0, 2e6)
    return n.unit(18_000.0) == 1.0 < n.unit(23_000.0)


@decides
def test_least_noise(m: Patch) -> bool:
    return abs(noise(False, 0.0, 100.0).unit(0.0) - 1e-8) < 1e-9


@decides
def test_refuted(m: Patch) -> bool:
    candidates = [made(place="a"), made(place="b")]
    odds = {candidates[0]: -11.0, candidates[1]: -13.0}
    m.setattr(whole_bench, "applied", lambda found, base: (found.space, np.zeros(0)))
    m.setattr(whole_bench, "exactly_undone", lambda space, *a, **k: {c: np.ones(1) for c in space.candidates})
    m.setattr(whole_bench, "scatter_prefers", lambda problem, space, values, new, old: odds[next(iter(new))])
    asked = bench(whole=Some(noise_known=True, captures=[]))
    m.setattr(asked, "_posterior", lambda rest, fixed, found: Some(score=0.0, space=Some(candidates=rest)))
    found = Some(score=0.0, space=Some(candidates=candidates))
    return asked._with_what_scatters_so(found, []).space.candidates == candidates[:1]
