"""Causes that are found only together, and values that go together along a curve, in problems of few values."""

from types import SimpleNamespace

import numpy as np
import pytest

from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit, held_out
from processing.diagnosis.search.linearization import quadratic
from processing.diagnosis.search.posterior import fit_posterior, posterior_of
from processing.diagnosis.search.sets import Group, Noise, Sets, State
from processing.diagnosis.search.space import Space, Sums
from processing.effect import Effect, Parameter

STATES, SINGLE, PIXELS = 24, 17, 5000
FREEDOM, DIRECTIONS = 2.0 * STATES * PIXELS, 40


def effect_of(kind: str) -> Effect:
    effect = Effect()
    effect.kind = kind
    return effect


class Bench:
    """Chi-square of values that act on the states alike in all pixels, a little bent, and of what nothing explains."""

    folds, noise_known, holds_out_states, spread = 1, True, False, 1.0

    def __init__(self, slopes: np.ndarray, bends: np.ndarray, truth: np.ndarray, unlisted: float) -> None:
        self.slopes, self.bends, self.truth, self.unlisted = slopes, bends, truth, unlisted

    def sums(self, space: Space, values: np.ndarray, *, derivatives: bool = True) -> Sums:
        at = np.concatenate([int(c.place) + np.arange(c.size) for c in space.candidates])
        x = np.zeros(self.truth.size)
        x[at] = values
        residual = self.slopes @ (x - self.truth) + self.bends @ (x**2 - self.truth**2)
        slopes = (self.slopes + 2 * self.bends * x)[:, at]
        out = Sums.empty(1, values.size if derivatives else 0)
        out.excess[0], out.freedom[0] = PIXELS * residual @ residual + self.unlisted, FREEDOM
        out.square[0] = out.count[0] = FREEDOM
        if derivatives:
            out.gradient[0], out.curvature[0] = PIXELS * slopes.T @ residual, PIXELS * slopes.T @ slopes
        return out

    def powers(self) -> list[tuple[int, np.ndarray]]:
        return [(DIRECTIONS, np.ones(1))]

    def relinearize(self, space: Space, values: np.ndarray) -> bool:
        return False

    def noise_information(self, space: Space, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((values.size, values.size)), np.zeros((values.size, values.size))

    def time_noise(self, space: Space, values: np.ndarray) -> np.ndarray:
        return np.zeros(values.size)


@pytest.fixture
def bench() -> tuple[Space, np.ndarray, np.ndarray, np.ndarray]:
    """A source that flickers and three small causes, beside others that are not there: space, slopes, bends, truth."""
    random = np.random.default_rng(3)
    per_state = [
        0.3 * np.vstack([np.eye(STATES), np.eye(STATES)]),
        np.vstack([np.diag(random.normal(0, 0.3, STATES)) for _ in range(2)]),
        np.vstack([np.diag(random.normal(0, 0.3, STATES)) for _ in range(2)]),
    ]
    slopes = np.column_stack([*per_state, 0.3 * random.normal(size=(2 * STATES, SINGLE))])
    bends = 0.05 * random.normal(size=slopes.shape) * (slopes != 0)
    many = 3 * STATES
    truth = np.zeros(many + SINGLE)
    truth[:STATES] = random.normal(0, 0.3, STATES)
    truth[many : many + 3] = 0.6, -0.5, 0.4
    sizes = [STATES] * 3 + [1] * SINGLE
    first = np.cumsum([0, *sizes])
    return (
        Space(
            tuple(
                Candidate(
                    effect_of(f"cause_{k}"),
                    str(first[k]),
                    tuple(Parameter(f"p{i}", "1", -9.0, 9.0, 1.0) for i in range(n)),
                )
                for k, n in enumerate(sizes)
            )
        ),
        slopes,
        bends,
        truth,
    )


def found(bench: tuple[Space, np.ndarray, np.ndarray, np.ndarray], unlisted: float) -> tuple[set[str], float]:
    space, *acts = bench
    out = fit_posterior(Bench(*acts, unlisted), space, (), [np.zeros(space.size)], say=lambda line: None)
    return {out.label(g).kind for g in out.free_groups}, out.samples.best.unit


def test_causes_that_leave_nothing_are_found_together(bench):
    kinds, unit = found(bench, unlisted=0.0)
    assert kinds == {"cause_0", "cause_3", "cause_4", "cause_5"}
    assert unit < 1.01


def test_structure_that_is_left_widens_the_unit(bench):
    assert found(bench, unlisted=5000.0)[1] > 10


class Valley:
    """Each of two parts asks that y = x^2, and that x is 3 or -3."""

    folds, noise_known, holds_out_states, spread = 2, True, False, 1.0
    targets, steep = (3.0, -3.0), 3.0

    def sums(self, space: Space, values: np.ndarray, *, derivatives: bool = True) -> Sums:
        x, y = values
        out = Sums.empty(2, 2 if derivatives else 0)
        for fold, at in enumerate(self.targets):
            residual = np.array([self.steep * (y - x * x), x - at])
            slopes = np.array([[-2 * self.steep * x, self.steep], [1.0, 0.0]])
            out.excess[fold], out.freedom[fold] = residual @ residual, 1.0
            out.square[fold], out.count[fold] = residual @ residual, 2.0
            if derivatives:
                out.gradient[fold], out.curvature[fold] = slopes.T @ residual, slopes.T @ slopes
        return out

    def powers(self) -> list[tuple[int, np.ndarray]]:
        return [(2, np.ones(1))]

    def relinearize(self, space: Space, values: np.ndarray) -> bool:
        return False

    def noise_information(self, space: Space, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((2, 2)), np.zeros((2, 2))

    def time_noise(self, space: Space, values: np.ndarray) -> np.ndarray:
        return np.zeros(values.size)


@pytest.fixture
def space() -> Space:
    effect = Effect()
    return Space(tuple(Candidate(effect, place, (Parameter("p", "1", -99.0, 99.0, 1.0),)) for place in "xy"))


def test_what_is_held_out_is_predicted_by_a_fit_and_not_by_one_step_off_the_valley(space):
    problem, start = Valley(), np.zeros(2)
    sums = problem.sums(space, start)
    check = held_out(problem, space, Fit(start, sums, float(sums.excess.sum())), np.full(2, 1e-6))
    # A part that asks for 3 is predicted from one that asks for -3; one step would leave 2 (3 x 9)^2.
    assert check.excess == pytest.approx(2 * 6.0**2, rel=0.05)


def test_a_mean_off_the_valley_gives_way_to_the_minimum_near_by(space):
    problem, about = Valley(), np.array([1.0, 1.0])
    problem.targets, problem.steep = (3.0, 3.0), 30.0
    form = quadratic(problem, space, about, problem.sums(space, about))
    sets = Sets(form, [Group(np.array([0])), Group(np.array([1]))], Noise(True, 2.0))
    state = State(np.full(2, 3.0))
    fit = sets.fitted(state)
    samples = SimpleNamespace(mean=fit.mean, covariance=fit.covariance, takes_part=np.ones(2, dtype=bool), best=state)
    off, on = (problem.sums(space, v).excess.sum() for v in (fit.mean, about))
    assert off > 10 * on
    posterior = posterior_of(problem, space, ((0,), (1,)), sets, samples=samples, about=about, rivals={})
    assert problem.sums(space, posterior.values).excess.sum() < on
