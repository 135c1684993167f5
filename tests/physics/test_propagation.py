"""Delta method: closed-form gradients against differences, and pulls of every quoted standard error by Monte Carlo."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.polarization import gradients, mueller
from processing.polarization.propagation import Derived, numeric_gradient
from processing.polarization.quantities import PAPER_PAIRS
from processing.polarization.scalar_files import Scalar, scalar_quantities

Array = NDArray[np.float64]
Group = Callable[[Array], dict[str, Derived]]


def with_pairs(m: Array) -> dict[str, Derived]:
    return gradients.pairs(m, PAPER_PAIRS | {"skew": ("45", "right")})


CLOSED_FORM: list[Group] = [
    gradients.coherency,
    gradients.depolarization_index,
    gradients.diattenuation,
    gradients.polarizance,
    gradients.symmetric_quantities,
    gradients.differential_quantities,
    with_pairs,
]
NUMERIC: list[Group] = [gradients.dominant, gradients.lu_chipman_quantities]


def scalar_group(scalar: Scalar) -> Group:
    def group(m: Array) -> dict[str, Derived]:
        return {scalar.name: scalar.derived(m)}

    group.__name__ = scalar.name
    return group


for _scalar in scalar_quantities().values():
    (NUMERIC if _scalar.gradient is None else CLOSED_FORM).append(scalar_group(_scalar))
EVERY = CLOSED_FORM + NUMERIC


def sample_matrix(seed: int = 3) -> Array:
    """A depolarizing diattenuating retarder with well separated eigenvalues, m00 = 1000 counts."""
    rng = np.random.default_rng(seed)
    q = np.linalg.qr(np.eye(4) + 0.3 * (rng.normal(size=(4, 4)) + 1j * rng.normal(size=(4, 4))))[0]
    h = (q * [0.08, 0.62, 0.22, 0.08 / 2]) @ q.conj().T
    # Most of the light goes through one strong element, so that no diattenuation is near zero.
    element = mueller.retarder(0.4, 1.2) @ mueller.diattenuator(0.9, 1.0, 0.25) @ mueller.rotation(0.25)
    m = element @ mueller.coherency_to_mueller(h)
    return 1000 * m / m[0, 0]


@pytest.fixture(scope="module")
def covariance() -> Array:
    """Covariance of the elements for the RGB950 at 662 nm, every intensity with the same noise."""
    model = InstrumentModel.load(Path(__file__).parents[2] / "configs/instruments/rgb950.yaml").at(662)
    w = model.rows(rotating_retarders(exposure_s=0.1).angles_deg).reshape(-1, 16)
    inverse = np.linalg.pinv(w)
    return np.asarray(0.2**2 * inverse @ inverse.T)


@pytest.mark.parametrize("group", CLOSED_FORM, ids=lambda g: g.__name__)
def test_closed_form_gradient_is_the_difference_quotient(group: Group) -> None:
    m = np.stack([sample_matrix(seed) for seed in range(6)])

    def values(name: str) -> Callable[[Array], Array]:
        return lambda x: np.moveaxis(group(x)[name].value.reshape(-1, len(m)), 0, -1)

    for name, derived in group(m).items():
        expected = np.moveaxis(numeric_gradient(values(name), m), -2, 0).reshape(derived.gradient.shape)
        # The differential decomposition does not exist for one or another of them: NaN on both sides.
        assert np.isfinite(expected).mean() > 0.5
        np.testing.assert_allclose(derived.gradient, expected, atol=1e-6 * np.nanmax(np.abs(expected)), err_msg=name)


@pytest.mark.parametrize("group", EVERY, ids=lambda g: g.__name__)
def test_pulls_have_unit_variance(group: Group, covariance: Array) -> None:
    truth, count = sample_matrix(), 1500
    rng = np.random.default_rng(11)
    noisy = (truth.reshape(16) + rng.multivariate_normal(np.zeros(16), covariance, size=count)).reshape(-1, 4, 4)
    expected, estimate = group(truth), group(noisy)
    for name, derived in estimate.items():
        sigma = np.sqrt(np.einsum("...i,ij,...j", derived.gradient, covariance, derived.gradient))
        true_value = expected[name].value[..., None]
        error = derived.value - true_value
        if name.endswith(("axis_deg", "orientation_deg")):
            error = (error + 90) % 180 - 90
        if name.endswith("or_90_deg"):
            error = (error + 45) % 90 - 45
        varies = sigma.max(axis=-1) > 1e-12  # an element that is 1 by definition has no error
        pull = (error / np.where(sigma > 0, sigma, 1))[varies]
        spread, bias = pull.std(axis=-1), pull.mean(axis=-1)
        # Five standard deviations of the sample's own scatter, and 3 % for the second order.
        np.testing.assert_allclose(spread, 1, atol=5 / np.sqrt(2 * count) + 0.03, err_msg=name)
        np.testing.assert_allclose(bias, 0, atol=5 / np.sqrt(count) + 0.05, err_msg=name)


def test_every_group_ignores_the_throughput(covariance: Array) -> None:
    m = sample_matrix()
    for group in EVERY:
        for name, derived in group(m).items():
            radial = np.sum(derived.gradient * m.reshape(16), axis=-1)
            np.testing.assert_allclose(radial, 0, atol=1e-5 * (1 + np.abs(derived.value).max()), err_msg=name)


def test_a_step_across_the_branch_cut_is_a_small_step() -> None:
    # Orientation near 0 = 180 degrees: the difference quotient without the period would be 180 / step.
    m = 100 * mueller.polarizer(1e-9, 0.3)
    derived = gradients.dominant(m)["dominant_diattenuation_orientation_deg"]
    closed = gradients.diattenuation(m)["diattenuation_orientation_deg"]
    assert np.abs(derived.gradient).max() < 10
    assert np.abs(closed.gradient).max() < 10
