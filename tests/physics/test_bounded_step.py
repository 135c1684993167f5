"""The step between bounds, against SciPy's bounded least squares."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from processing.diagnosis.search.bounded_step import bounded_step

#: A change of one value at a time took more than 20,000 changes for each of the last five, and did not end in minutes.
SEEDS = (1, 2, 3, 23, 24, 25, 26, 27)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_polynomial_with_bounds_is_the_one_of_scipy(seed):
    """Of degree 29: powers of x are nearly the same function, so bounds exclude each other in many ways."""
    random, x = np.random.default_rng(seed), np.linspace(-1, 1, 60)
    powers = np.vander(x, 30, increasing=True)
    y = 3 * np.sign(np.sin(7 * x)) + random.normal(size=x.size)
    a, b = np.vstack([powers, 1e-4 * np.eye(30)]), np.append(y, np.zeros(30))
    expected = lsq_linear(a, b, (-1, 1), method="bvls", tol=1e-14).x
    one = np.ones(30)
    step = bounded_step(-a.T @ b, a.T @ a, -one, one, free=one > 0)
    assert np.sum(np.abs(expected) == 1) > 10
    assert np.sum((a @ step - b) ** 2) <= (1 + 1e-9) * np.sum((a @ expected - b) ** 2)


def test_values_that_are_held_or_have_no_room_stay():
    random = np.random.default_rng(1)
    for n in random.integers(2, 12, 200):
        a, free = random.normal(size=(n + 3, n)), random.random(n) > 0.2
        b = a @ random.normal(size=n) + random.normal(size=n + 3)
        low, high = (side * random.random(n) * (random.random(n) > 0.3) for side in (-1, 1))
        step = bounded_step(-a.T @ b, a.T @ a, low, high, free=free)
        assert np.all(step[~free | (low == high)] == 0)
        assert np.all((step >= low) & (step <= high))
        moves = free & (low < high)
        if moves.any():
            best = lsq_linear(a[:, moves], b, (low[moves], high[moves]), method="bvls", tol=1e-14)
            assert np.sum((a @ step - b) ** 2) == pytest.approx(2 * best.cost, rel=1e-9)
