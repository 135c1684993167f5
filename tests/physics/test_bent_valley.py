"""Where two values go together along a curve, a step as long as the data let it be ends beside it."""

from types import SimpleNamespace

import numpy as np
import pytest

from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit, held_out
from processing.diagnosis.search.linearization import quadratic
from processing.diagnosis.search.posterior import _posterior_of
from processing.diagnosis.search.sets import Group, Noise, Sets, State
from processing.diagnosis.search.space import Space, Sums
from processing.effect import Effect, Parameter


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

    def noise_information(self, space: Space, values: np.ndarray) -> np.ndarray:
        return np.zeros((2, 2))

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
    samples = SimpleNamespace(mean=fit.mean, covariance=fit.covariance, probability=np.ones(2), best=state)
    off, on = (problem.sums(space, v).excess.sum() for v in (fit.mean, about))
    assert off > 10 * on
    posterior = _posterior_of(problem, space, ((0,), (1,)), sets, samples=samples, about=about, rivals={})
    assert problem.sums(space, posterior.values).excess.sum() < on
