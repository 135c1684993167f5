"""The fast posterior over sets of groups against all sets, one by one; and what a prior must do."""

from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import betaln

from processing.diagnosis.search.averages import likely_starts, stay
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import causes
from processing.diagnosis.search.correction import needed_groups
from processing.diagnosis.search.decision import predicted_change
from processing.diagnosis.search.fit import minimize
from processing.diagnosis.search.likely_set import likely_set
from processing.diagnosis.search.linearization import quadratic
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.range_of import least_apart
from processing.diagnosis.search.rules import FAR, TAU, TAU_WEIGHT, TAU_WEIGHT_OF_MANY
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets, State
from processing.diagnosis.search.space import Space, Sums
from processing.effect import Effect, Parameter
from processing.instrument.effects.rotation_slip import RotationSlip

#: Nothing but noise, whose unit is one.
QUIET = Noise(is_known=True, directions=30.0, slack=1e9)
#: Absent, and the standard deviations that are possible at all.
WIDTHS = [0.0, *TAU[TAU_WEIGHT > 0]]


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
    scores, presence = [], []
    for tau in product(WIDTHS, repeat=4):
        scores.append(sets.fitted(State(np.array(tau))).score)
        presence.append(np.array(tau) > 0)
    weight = np.exp(np.array(scores) - max(scores))
    exact = weight @ np.array(presence) / weight.sum()
    posterior = stay(sets, likely_starts(sets, likely_set(sets)), 800)
    assert posterior.probability == pytest.approx(exact, abs=0.08)
    # Which of the two alike is open, that one is there is not.
    assert 0.05 < exact[0] < 0.999
    assert posterior.any_of([0, 1]) > 0.99


def test_a_width_that_is_learnt_is_that_of_all_widths():
    """Levels that are always there hardly vary: their width follows, and with it the odds of what looks like them."""
    random = np.random.default_rng(4)
    design = random.standard_normal((60, 13)) * 8
    design[:, 12] = design[:, :12] @ random.standard_normal(12) / 3
    truth = np.append(0.03 * random.standard_normal(12), 0.1)
    levels, cause = Group(np.arange(12), always=True), Group(np.array([12]))
    sets = Sets(form(design, truth), [levels, cause], QUIET)
    states = [State(np.array(tau)) for tau in product(TAU[TAU_WEIGHT_OF_MANY > 0], WIDTHS)]
    weight = np.exp([sets.score(state) - sets.score(states[0]) for state in states])
    exact = weight @ [state.tau[1] > 0 for state in states] / weight.sum()
    assert 0.7 < exact < 0.95
    posterior = stay(sets, likely_starts(sets, likely_set(sets)), 800)
    assert posterior.probability == pytest.approx([1.0, exact], abs=0.04)
    # With a wide prior of the levels the data say nothing of the cause.
    wide = Sets(sets.form, [Group(np.arange(12), always=True, fixed_tau=10.0), cause], QUIET)
    assert stay(wide, likely_starts(wide, likely_set(wide)), 800).probability[1] == pytest.approx(0.5, abs=0.01)


def test_where_the_noise_is_unknown_it_is_one_of_the_unknowns():
    """In the noise that the likeliest set leaves, all that is absent would look too unlikely, and it too certain."""
    random = np.random.default_rng(11)
    design = random.standard_normal((12, 2)) * 5
    data = 20 * (design @ np.array([0.25, -0.2]) + random.standard_normal(12))
    problem = Quadratic(float(data @ data), -20 * design.T @ data, 400 * design.T @ design)
    sets = Sets(problem, groups(1, 1), Noise(is_known=False, directions=12.0, floor=1e-3))
    states = [State(np.array(tau), u) for tau in product(WIDTHS, repeat=2) for u in np.geomspace(20, 2e4, 30)]
    scores = np.array([sets.score(state) for state in states])
    weight = np.exp(scores - scores.max())
    weight /= weight.sum()
    exact = weight @ np.array([state.tau > 0 for state in states])
    assert np.all((exact > 0.2) & (exact < 0.98))
    samples = stay(sets, likely_starts(sets, likely_set(sets)), 3000)
    assert samples.probability == pytest.approx(exact, abs=0.05)
    second = np.zeros(2)
    for w, state in zip(weight, states, strict=True):
        if w > 1e-6:
            fit = sets.fitted(state)
            second[fit.active] += w * (np.diag(fit.covariance) + fit.mean**2)
    assert np.diag(samples.covariance) + samples.mean**2 == pytest.approx(second, rel=0.1)


def test_any_number_of_causes_is_as_likely_whatever_sentences_there_are():
    """With 200 sentences of a price of 3, a bench had 15 to 22 of 26 causes, and as many sentences."""
    causes = [*groups(1, 1, 1, 1), *(Group(np.array([4 + k]), share=2.0, price=1.5) for k in range(6))]
    sets = Sets(Quadratic(0.0, np.zeros(10), np.zeros((10, 10))), causes, QUIET)
    every = [np.array(chosen, dtype=bool) for chosen in product([False, True], repeat=10)]
    probability = np.exp([sets.log_prior(chosen) for chosen in every])
    assert probability.sum() == pytest.approx(1)
    number = np.bincount([chosen[:4].sum() for chosen in every], weights=probability)
    assert number == pytest.approx(np.full(5, 0.2))
    for chosen in every[::37]:
        with_it, without = (np.where(np.eye(10, dtype=bool), value, chosen) for value in (True, False))
        odds = [sets.log_prior(a) - sets.log_prior(b) for a, b in zip(with_it, without, strict=True)]
        assert sets.prior_odds(chosen) == pytest.approx(odds)


def test_what_no_data_show_tells_nothing_of_how_many_causes_there_are():
    """Such groups began as absent, and a chain learnt from them that causes are rare."""
    gradient = np.array([40.0, -35.0, 50.0, 3.0, 2.0, *np.zeros(9)])
    curvature = np.diag([90.0, 60.0, 80.0, 6.0, 5.0, *np.zeros(9)])
    sets = Sets(Quadratic(0.0, gradient, curvature), groups(*[1] * 14), QUIET)
    every = [np.array(chosen, dtype=bool) for chosen in product([False, True], repeat=14)]
    factor = np.exp(sets.conditional(sets.empty()).log_factor)
    weight = np.array([np.exp(sets.log_prior(chosen)) * factor[chosen].prod() for chosen in every])
    exact = weight @ np.array(every) / weight.sum()
    samples = stay(sets, likely_starts(sets, likely_set(sets)), 300)
    assert samples.probability == pytest.approx(exact, abs=0.02)
    # Three causes of five make the others likely; that is no reason to correct them.
    assert exact[5:].min() > 0.7
    assert samples.takes_part[:3].all()
    assert not samples.takes_part[5:].any()


def test_the_chance_of_a_worse_result_is_that_of_all_sets():
    """What no data show is absent or large: that is no normal distribution of a small width."""
    problem = Quadratic(50.0, np.array([-0.35 * 400, 0.0]), np.diag([400.0, 1e-6]))
    sets = Sets(problem, groups(1, 1), QUIET)
    samples = stay(sets, likely_starts(sets, likely_set(sets)), 1000)
    random, ones, correction = np.random.default_rng(3), np.ones((2, 2)), np.array([samples.mean[0], 0.0])
    states = [State(np.array(tau)) for tau in product(WIDTHS, repeat=2)]
    scores = np.array([sets.score(state) for state in states])
    weight = np.exp(scores - scores.max())
    fits, grew = [sets.fitted(state) for state in states], []
    for k in random.choice(len(states), 20_000, p=weight / weight.sum()):
        fit, true = fits[k], np.zeros(2)
        true[fit.active] = fit.mean + np.sqrt(np.diag(fit.covariance)) * random.standard_normal(fit.active.size)
        grew.append(abs((true - correction).sum()) > abs(true.sum()))
    change = predicted_change(correction, samples.mean, samples.covariance, ones, along=samples.along)
    assert change.chance_worse == pytest.approx(np.mean(grew), rel=0.25)
    normal = predicted_change(correction, samples.mean, samples.covariance, ones)
    assert normal.chance_worse > 1.5 * np.mean(grew)


def test_one_cause_that_does_what_two_do_has_its_share_from_either_side():
    """Between them lies a set of all three, or one that leaves half of the data: no chain passes that."""
    half = 60 * np.random.default_rng(5).standard_normal((90, 4))
    design = np.hstack([half, half])
    causes = [*(Group(g.index, price=5.5) for g in groups(2, 2)), Group(np.arange(4, 8), price=12.0)]
    sets = Sets(form(design, np.array([0.5, -0.4, 0.3, 0.5, 0, 0, 0, 0]), 2), causes, QUIET)
    taus = np.array(list(product(WIDTHS, repeat=3)))
    scores = np.array([sets.fitted(State(tau)).score for tau in taus])
    weight = np.exp(scores - scores.max())
    exact = float(weight @ (taus[:, 2] > 0) / weight.sum())
    assert 0.2 < exact < 0.8
    for start in ([0.3, 0.3, 0.0], [0.0, 0.0, 0.3]):
        assert stay(sets, likely_starts(sets, State(np.array(start))), 1000).probability[2] == pytest.approx(
            exact, abs=0.2
        )


def test_a_rare_cause_of_nearly_all_structure_is_found_behind_common_ones_that_explain_nothing():
    """What it leaves has a smaller unit, in which it is plain; in the unit of all structure nothing is."""
    curvature = np.diag([1.0] * 30 + [1500.0])
    gradient = np.append(np.zeros(30), -np.sqrt(14_500 * 1500.0))
    causes = [*groups(*(1 for _ in range(30))), Group(np.array([30]), price=9.0)]
    sets = Sets(Quadratic(18_000.0, gradient, curvature), causes, Noise(True, directions=24.0, slack=400.0))
    state = State(np.append(np.zeros(30), FAR))
    assert sets.fitted(sets.settled(state)).score > sets.fitted(sets.empty()).score + 2
    assert np.flatnonzero(likely_set(sets).tau).tolist() == [30]


def test_what_is_unlikely_one_by_one_is_likely_together():
    """Thirty weak groups: no set of them is likely, and each keeps its probability and its variance."""
    size, curvature = 30, 50.0
    gradient = np.sqrt(curvature) * np.random.default_rng(19).normal(0, 1.5, size)
    sets = Sets(Quadratic(0.0, gradient, curvature * np.eye(size)), groups(*[1] * size), QUIET)
    posterior = stay(sets, likely_starts(sets, sets.empty()), 300)
    # Independent data: sums over all sets of one size are elementary symmetric polynomials of the Bayes factors.
    width = 1 / (curvature + TAU**-2.0)
    factor = np.sqrt(width) / TAU * np.exp(0.5 * gradient[:, None] ** 2 * width)
    factor *= TAU_WEIGHT
    count = np.arange(size + 1)
    prior = np.exp(betaln(1 + count, size - count + 1))
    total = prior @ symmetric(factor.sum(axis=1))
    exact = np.array(
        [f * (prior[1:] @ symmetric(np.delete(factor.sum(axis=1), k))) for k, f in enumerate(factor.sum(axis=1))]
    )
    exact /= total
    weight = factor / factor.sum(axis=1, keepdims=True)
    mean = -gradient[:, None] * width
    square = exact * np.sum(weight * (width + mean**2), axis=1)
    variance = square - (exact * np.sum(weight * mean, axis=1)) ** 2
    assert posterior.probability == pytest.approx(exact, abs=0.05)
    assert np.diag(posterior.covariance).sum() == pytest.approx(variance.sum(), rel=0.15)


def symmetric(factors):
    """Sums (N + 1,) over all sets of 0, 1, ... N of the products of their factors (N,)."""
    out = np.zeros(len(factors) + 1)
    out[0] = 1.0
    for f in factors:
        out[1:] += f * out[:-1]
    return out


def test_two_small_causes_are_found_beside_values_that_imitate_them():
    """A slip and a ratio of an axis explain together what an error of every state explains, with fewer values."""
    states = np.arange(40)
    slip, ratio = (states > 14) * 1.0, states / 39 - 0.5
    design = 60 * np.column_stack([np.eye(40), slip, ratio])
    truth = np.concatenate([np.zeros(40), [0.5, -0.6]])
    sets = Sets(form(design, truth, 29), [*groups(40), Group(np.array([40]), 38.0), Group(np.array([41]))], QUIET)
    assert likely_set(sets).tau[1:].all()
    assert not likely_set(sets).tau[0]


def test_the_mean_is_nearer_to_the_truth_than_the_data_are():
    """Values for each state of a source that hardly flickers come out as small as they are."""
    random = np.random.default_rng(5)
    truth = 0.05 * random.standard_normal(40)
    design = np.vstack([np.eye(40) * 10.0])
    sets = Sets(form(design, truth), groups(40), QUIET)
    posterior = stay(sets, likely_starts(sets, likely_set(sets)), 50)
    alone = -np.linalg.solve(sets.form.curvature, sets.form.gradient)
    assert np.linalg.norm(posterior.mean - truth) < 0.7 * np.linalg.norm(alone - truth)


def test_nothing_is_there_where_nothing_is():
    random = np.random.default_rng(7)
    design = 30 * random.standard_normal((200, 60))
    for seed in range(5):
        sets = Sets(form(design, np.zeros(60), seed), groups(*[1] * 40, *[4] * 5), QUIET)
        assert stay(sets, likely_starts(sets, likely_set(sets)), 100).probability.max() < 0.9


def test_several_causes_that_are_plain_only_together_are_found():
    """Each alone explains a part, and what is left beside it hides it."""
    random = np.random.default_rng(11)
    design = 100 * random.standard_normal((60, 30))
    truth = np.zeros(30)
    truth[[2, 7, 11, 19, 23, 28]] = random.choice([-1, 1], 6)
    noise = Noise(is_known=True, directions=25.0, slack=25.0)
    state = likely_set(Sets(form(design, truth), groups(*[1] * 30), noise))
    assert set(np.flatnonzero(state.tau)) == {2, 7, 11, 19, 23, 28}
    assert state.unit == 1.0


def test_structure_that_no_set_explains_widens_the_errors():
    random = np.random.default_rng(13)
    design = 10 * random.standard_normal((60, 6))
    data = design @ np.array([1.0, 0, 0, 0, 0, 0]) + 30 * random.standard_normal(60)
    quadratic = Quadratic(float(data @ data - 60), -design.T @ data, design.T @ design)
    state = likely_set(Sets(quadratic, groups(*[1] * 6), Noise(is_known=True, directions=60.0, slack=22.0)))
    assert state.unit == pytest.approx(900, rel=0.4)
    assert not state.tau[1:].any()


def test_two_that_say_the_same_share_the_mean():
    random = np.random.default_rng(17)
    design = 100 * random.standard_normal((90, 60))
    design[:, 1] = design[:, 0]
    sets = Sets(form(design, np.eye(60)[0] + np.eye(60)[5] - np.eye(60)[7]), groups(*[1] * 60), QUIET)
    posterior = stay(sets, likely_starts(sets, likely_set(sets)), 1500)
    assert posterior.probability[:2] == pytest.approx(0.5, abs=0.15)
    assert posterior.mean[:2] == pytest.approx(0.5, abs=0.15)


def test_a_descent_stays_where_the_model_has_numbers():
    """A step to where there are no intensities is no gain, though nan is not larger than anything."""
    space = Space((Candidate(Effect(), "", (Parameter("p", "1", -9.0, 9.0, 1.0),)),))

    def sums(space, x, derivatives=True):
        excess = 25.0 if x[0] == 0 else np.nan
        unit = np.ones((1, 1))
        return SimpleNamespace(
            excess=np.array([excess]),
            freedom=np.array([10.0]),
            gradient=-5 * unit,
            curvature=unit[None],
            stretch=0 * unit,
        )

    problem = SimpleNamespace(folds=1, relinearize=lambda space, x: False, sums=sums)
    assert minimize(problem, space, np.zeros(1), weak=np.zeros(1)).values == 0.0


def test_of_those_that_may_be_there_alone_never_two_are():
    """Two curves and a third cause beside each other describe nearly anything; a detector has one."""
    random = np.random.default_rng(9)
    design = random.standard_normal((200, 6))
    design[:, 1] = design[:, 0] + 0.05 * design[:, 1]
    quadratic = form(20 * design, np.array([2.0, -1.0, 0.5, 0.0, 0.0, 0.0]))
    alike = [Group(np.array([k]), alone=k < 2) for k in range(6)]
    sets = Sets(quadratic, alike, Noise(is_known=True, directions=30.0, slack=1e9))
    assert likely_set(Sets(quadratic, groups(*(1,) * 6), sets.noise)).tau[:2].all()
    state = likely_set(sets)
    assert np.sum(state.tau[:2] > 0) == 1
    samples = stay(sets, likely_starts(sets, state), 400)
    assert float(samples.weight @ samples.sets[:, :2].all(axis=1)) == 0


def test_the_state_that_a_slip_begins_at_is_one_of_those_that_the_data_leave_open():
    """That the axis slipped is certain, and one frame that hardly saw it tells from which state on."""
    states = np.arange(40)
    sensitivity = np.where(states == 14, 0.02, 1.0)
    design = 100 * np.column_stack([sensitivity * (states >= first) for first in (13, 14, 15)])
    space = Space(tuple(slipped(first) for first in (13, 14, 15)))
    sets = Sets(form(design, np.array([0.0, 0.5, 0.0]), 30), groups(1, 1, 1), QUIET)
    state = likely_set(sets)
    samples = SimpleNamespace(best=state, any_of=lambda members: 1.0)
    posterior = Posterior(space, ((0,), (1,), (2,)), sets, samples, np.zeros(3), np.eye(3), {})
    (cause,) = causes(posterior, 0.0)
    places = {c.place for c in (*cause.candidates, *cause.alternatives)}
    assert cause.answer == "one of"
    assert places == {"psg@14", "psg@15"}
    assert cause.other_effects == ()


def slipped(first):
    return Candidate(RotationSlip(), f"psg@{first}", (Parameter("slip", "degree", -45, 45, 1.0),), 0)


def test_a_correction_has_the_groups_that_it_needs_and_no_more():
    """In order of probability it took up to 300 groups, and an instrument file cannot hold so many."""
    random = np.random.default_rng(5)
    design = random.standard_normal((60, 30))
    # Two of them cancel but for a part: neither fits without the other.
    design[:, 4] = design[:, 3] + 0.3 * random.standard_normal(60)
    mean = 0.01 * random.standard_normal(30)
    mean[:5] = 0.0, 2.0, 2.0, 5.0, -5.0
    curvature = design.T @ design
    quadratic, index = Quadratic(0.0, -curvature @ mean, curvature), [np.array([k]) for k in range(30)]
    kept = np.arange(30) == 0
    assert needed_groups(quadratic, mean, index, kept=kept, most=1.0).tolist() == [0, 1, 2, 3, 4]
    assert needed_groups(quadratic, mean, index, kept=kept, most=0.0).size == 30


def test_a_value_that_shows_nothing_next_to_a_steep_direction_is_kept_out():
    """An offset beside a slip at a nearly singular W: rounding of 2e15 hides a curvature of -36."""
    sums = Sums.empty(1, 2)
    sums.freedom[:], sums.gradient[:] = 1000.0, [[3.0, 1.0]]
    sums.curvature[0] = np.diag([2e15, 1.0])
    space = SimpleNamespace(joined=lambda name: np.ones(2))
    problem = SimpleNamespace(
        noise_known=True,
        noise_information=lambda space, x: (np.zeros((2, 2)), np.diag([0.0, 37.0])),
        time_noise=lambda space, x: np.zeros(2),
    )
    form = quadratic(problem, space, np.zeros(2), sums)
    assert np.diag(form.curvature).min() >= 0
    state = State(np.ones(2))
    assert abs(Sets(form, [Group(np.array([k])) for k in range(2)], Noise(True, 10.0)).fitted(state).mean[1]) < 1e-12


def test_the_nearest_two_of_several_signatures():
    plane, axis = np.eye(3)[:, :2], np.eye(3)[:, 2:]
    tilted = np.array([[0.0], [np.cos(np.pi / 6)], [np.sin(np.pi / 6)]])
    assert least_apart([plane]) == 1.0
    assert least_apart([5 * plane, axis]) == pytest.approx(1.0)
    assert least_apart([axis[[2, 0, 1]], tilted, axis]) == pytest.approx(np.cos(np.pi / 6))
    # Half of the line is outside the plane. No line reaches the plane.
    assert least_apart([5 * plane, 3 * tilted, axis]) == pytest.approx(0.5)
    assert least_apart([plane, 0 * axis]) == 0.0
