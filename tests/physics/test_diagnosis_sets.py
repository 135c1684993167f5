"""The fast posterior over sets of groups against all sets, one by one; and what a prior must do."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest

from processing.diagnosis.instrument.doubts import ONE_PATTERN, patterned_share
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.likely_set import likely_set
from processing.diagnosis.search.posterior import descend
from processing.diagnosis.search.rules import TAU
from processing.diagnosis.search.sampling import sample
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets, State
from processing.diagnosis.search.space import Space
from processing.effect import Parameter

#: Nothing but noise, whose unit is one.
QUIET = Noise(known=True, directions=30.0, slack=1e9)


def form(design, truth, seed=0):
    """Chi-square of data = design x + unit noise, minus the number of data."""
    data = design @ truth + np.random.default_rng(seed).standard_normal(len(design))
    return Quadratic(float(data @ data - len(design)), -design.T @ data, design.T @ design)


def groups(*sizes):
    ends = np.cumsum(sizes)
    return [Group(np.arange(end - size, end)) for size, end in zip(sizes, ends, strict=True)]


def test_probabilities_are_those_of_all_sets():
    random = np.random.default_rng(3)
    design = random.standard_normal((40, 5)) * np.array([6, 6, 3, 3, 2])
    # Two that are nearly the same, one that is there, one of two values that is weak.
    design[:, 1] = design[:, 0] + 0.3 * random.standard_normal(40)
    sets = Sets(form(design, np.array([0.5, 0, 1.0, 0, 0.2])), groups(1, 1, 1, 2), QUIET)
    scores, there = [], []
    for tau in product([0.0, *TAU], repeat=4):
        scores.append(sets.fitted(State(np.array(tau))).score)
        there.append(np.array(tau) > 0)
    weight = np.exp(np.array(scores) - max(scores))
    exact = weight @ np.array(there) / weight.sum()
    found = sample(sets, likely_set(sets), 600)
    assert found.probability == pytest.approx(exact, abs=0.08)
    # Which of the two alike is open, that one is there is not.
    assert 0.05 < exact[0] < 0.999
    assert found.any_of([0, 1]) > 0.99


def test_the_mean_is_nearer_to_the_truth_than_the_data_are():
    """Values for each state of a source that hardly flickers come out as small as they are."""
    random = np.random.default_rng(5)
    truth = 0.05 * random.standard_normal(40)
    design = np.vstack([np.eye(40) * 10.0])
    sets = Sets(form(design, truth), groups(40), QUIET)
    found = sample(sets, likely_set(sets), 50)
    alone = -np.linalg.solve(sets.form.curvature, sets.form.gradient)
    assert np.linalg.norm(found.mean - truth) < 0.7 * np.linalg.norm(alone - truth)


def test_nothing_is_there_where_nothing_is():
    random = np.random.default_rng(7)
    design = 30 * random.standard_normal((200, 60))
    for seed in range(5):
        sets = Sets(form(design, np.zeros(60), seed), groups(*[1] * 40, *[4] * 5), QUIET)
        assert sample(sets, likely_set(sets), 100).probability.max() < 0.9


def test_several_causes_that_are_plain_only_together_are_found():
    """Each alone explains a part, and what is left beside it hides it."""
    random = np.random.default_rng(11)
    design = 100 * random.standard_normal((60, 30))
    truth = np.zeros(30)
    truth[[2, 7, 11, 19, 23, 28]] = random.choice([-1, 1], 6)
    noise = Noise(known=True, directions=25.0, slack=25.0)
    state = likely_set(Sets(form(design, truth), groups(*[1] * 30), noise))
    assert set(np.flatnonzero(state.tau)) == {2, 7, 11, 19, 23, 28}
    assert state.unit == 1.0


def test_structure_that_no_set_explains_widens_the_errors():
    random = np.random.default_rng(13)
    design = 10 * random.standard_normal((60, 6))
    data = design @ np.array([1.0, 0, 0, 0, 0, 0]) + 30 * random.standard_normal(60)
    quadratic = Quadratic(float(data @ data - 60), -design.T @ data, design.T @ design)
    state = likely_set(Sets(quadratic, groups(*[1] * 6), Noise(known=True, directions=60.0, slack=22.0)))
    assert state.unit == pytest.approx(900, rel=0.4)
    assert not state.tau[1:].any()


def test_two_that_say_the_same_share_the_mean():
    random = np.random.default_rng(17)
    design = 100 * random.standard_normal((90, 60))
    design[:, 1] = design[:, 0]
    sets = Sets(form(design, np.eye(60)[0] + np.eye(60)[5] - np.eye(60)[7]), groups(*[1] * 60), QUIET)
    found = sample(sets, likely_set(sets), 30)
    assert found.probability[:2] == pytest.approx(0.5, abs=0.1)
    assert found.mean[:2] == pytest.approx(0.5, abs=0.1)


def test_values_of_a_jump_beside_a_slope_are_not_random():
    k = np.arange(40)
    information = np.eye(40) * 1e4
    assert patterned_share(np.where(k > 15, 0.5, -0.3) - 0.02 * k, information) > ONE_PATTERN
    assert patterned_share(np.cos(0.7 * k), information) > ONE_PATTERN
    assert patterned_share(np.random.default_rng(2).standard_normal(40), information) < ONE_PATTERN


def test_a_descent_stays_where_the_model_has_numbers():
    """A step to where there are no intensities is no gain, though nan is not larger than anything."""
    space = Space((Candidate(type("E", (), {"kind": "it"})(), "", (Parameter("p", "1", -9.0, 9.0, 1.0),)),))

    def sums(space, x, derivatives=True):
        excess = 25.0 if x[0] == 0 else np.nan
        one = np.ones((1, 1))
        return SimpleNamespace(
            excess=np.array([excess]), freedom=np.array([10.0]), gradient=-5 * one, curvature=one[None], stretch=0 * one
        )

    problem = SimpleNamespace(relinearize=lambda space, x: False, sums=sums)
    assert descend(problem, space, np.zeros(1), np.zeros(1)) == 0.0
