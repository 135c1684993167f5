"""Causes that together leave nothing but noise are found together, though none explains much alone."""

import numpy as np
import pytest

from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.posterior import fit_posterior
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

    def noise_information(self, space: Space, values: np.ndarray) -> np.ndarray:
        return np.zeros((values.size, values.size))

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
    out = fit_posterior(Bench(*acts, unlisted), space, (), np.zeros(space.size), say=lambda line: None)
    return {out.label(g).kind for g in out.free_groups}, out.samples.best.unit


def test_causes_that_leave_nothing_are_found_together(bench):
    kinds, unit = found(bench, unlisted=0.0)
    assert kinds == {"cause_0", "cause_3", "cause_4", "cause_5"}
    assert unit < 1.01


def test_structure_that_is_left_widens_the_unit(bench):
    assert found(bench, unlisted=5000.0)[1] > 10
