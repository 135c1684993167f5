"""Values that are only known together are told as the combination that is known."""

import numpy as np
import pytest

from processing.diagnosis.verdict.answer import ties


def test_a_sum_that_is_known_is_told_and_what_is_known_alone_is_not():
    # Leaks of two polarizers, of which air shows the sum to 0.0002; an azimuth beside them.
    along, across = np.array([1, 1, 0]) / np.sqrt(2), np.array([1, -1, 0]) / np.sqrt(2)
    covariance = 0.0002**2 / 2 * np.outer(along, along) + 0.004**2 * np.outer(across, across)
    covariance[2, 2] = 0.01**2
    values = np.array([0.001, 0.002, 0.3])
    (tie,) = ties(values, covariance, np.array([0.01, 0.01, 1.0]))
    assert tie.index.tolist() == [0, 1]
    assert tie.weights == pytest.approx([1, 1])
    assert tie.value == pytest.approx(0.003)
    assert tie.stderr == pytest.approx(0.0002)
    assert np.abs(tie.open_by) == pytest.approx([0.004 / np.sqrt(2)] * 2)
    assert tie.open_by[0] * tie.open_by[1] < 0


def test_values_of_other_units_are_weighed_in_units_of_the_first():
    # One degree does what 0.02 of light does.
    along, across = np.array([1.0, 0.02]), np.array([1.0, -0.02])
    covariance = 1e-4 * np.outer(along, along) + np.outer(across, across)
    (tie,) = ties(np.array([0.5, 0.01]), covariance, np.array([1.0, 0.02]))
    assert tie.weights == pytest.approx([1, 50])
    assert tie.value == pytest.approx(1.0)
    assert tie.stderr == pytest.approx(0.02)


def test_independent_values_are_not_tied():
    assert not list(ties(np.ones(4), np.diag([1.0, 2.0, 3.0, 4.0]), np.ones(4)))
