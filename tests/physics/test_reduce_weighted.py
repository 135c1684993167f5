"""Noise-weighted reduction and physical estimates, against numpy one pixel at a time."""

from pathlib import Path

import numpy as np
import pytest
import scipy.optimize
from reduced_capture import reduced

from processing.errors import ProcessError
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.polarization import mueller
from processing.polarization.physical import most_likely, nearest
from processing.reduction.mueller import reduce_mueller
from processing.reduction.mueller_reduction import Choice, MuellerReduction
from processing.reduction.solvers.weighted import PACKED_COLUMN, PACKED_ROW
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Product, Step

GAIN, READ, BLACK = 2.5, 3.0, 64.0
DETECTOR = {"black_level_counts": BLACK, "gain_e_per_count": GAIN, "read_noise_e": READ, "bits": 16}
ANGLES = {"psg": 9.0 * np.arange(40), "psa": 4.91 * 9.0 * np.arange(40)}


def pure(rng: np.random.Generator, xi0: float = 0.97) -> np.ndarray:
    """Mueller matrix (4, 4), m00 = 1: a random Mueller-Jones matrix with a little depolarization."""
    jones = rng.normal(size=(2, 2)) + 1j * rng.normal(size=(2, 2))
    m = mueller.from_jones(jones)
    return (4 * xi0 - 1) / 3 * m / m[0, 0] + 4 * (1 - xi0) / 3 * mueller.IDEAL_DEPOLARIZER


def capture_of(m: np.ndarray, rng: np.random.Generator, model: InstrumentModel, write) -> Path:
    """Noisy capture of a uniform or varying Mueller image (4, 4, rows, columns) in counts."""
    signal = np.einsum("nck,kxy->ncxy", model.rows(ANGLES), m.reshape(16, *m.shape[2:]))
    electrons = rng.poisson(np.maximum(signal, 0) * GAIN) + rng.normal(0, READ, signal.shape)
    counts = np.clip(np.rint(electrons / GAIN + BLACK), 0, 2**16 - 1).astype(np.uint16)
    return write(counts, ANGLES, detector=DETECTOR)


def test_unit_variance_and_smaller_errors(rgb950: InstrumentModel, synthetic_capture) -> None:
    rng = np.random.default_rng(2)
    m = np.broadcast_to(2500 * pure(rng)[..., None, None], (4, 4, 40, 50)).copy()
    path = capture_of(m, rng, rgb950, synthetic_capture)
    weighted, plain = (reduced(path, rgb950, choice=Choice(weighted=flag)) for flag in (True, False))
    pulls = (weighted.values - m) / weighted.errors
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=0.03)
    assert np.mean(weighted.errors**2) < 0.9 * np.mean(plain.errors**2)
    assert np.mean((weighted.values - m) ** 2) < 0.92 * np.mean((plain.values - m) ** 2)
    assert weighted.facts["median_reduced_chi_square"] == pytest.approx(1.0, abs=0.06)


def test_unknown_noise_is_an_error(rgb950: InstrumentModel, synthetic_capture) -> None:
    path = synthetic_capture(np.ones((40, 1, 4, 6)), ANGLES)
    with pytest.raises(ProcessError, match="does not know its gain"):
        reduced(path, rgb950, choice=Choice(weighted=True))
    with pytest.raises(ProcessError, match="need the weighted"):
        Choice(covariance=True)
    with pytest.raises(ProcessError, match="none of nearest, likelihood"):
        Choice(physical="closest")


def smallest_eigenvalue(planes: np.ndarray) -> np.ndarray:
    return np.linalg.eigvalsh(mueller.coherency(planes.T.reshape(-1, 4, 4).astype(float)))[:, 0]


def test_nearest_is_physical_and_nearest() -> None:
    rng = np.random.default_rng(3)
    m = np.stack([pure(rng, 1.0) + rng.normal(0, 0.05, (4, 4)) for _ in range(20)]).reshape(20, 16).T
    estimate = nearest(m)
    assert np.all(smallest_eigenvalue(estimate) > -1e-12)
    # Nothing physical is closer: compare with a general minimizer over M = sum of Mueller-Jones matrices.
    for p in range(3):

        def distance(x: np.ndarray, target: np.ndarray = m[:, p]) -> float:
            factor = (x[:16] + 1j * x[16:]).reshape(4, 4)
            candidate = mueller.coherency_to_mueller(factor @ factor.conj().T).reshape(16)
            return float(np.sum((candidate - target) ** 2))

        best = min(scipy.optimize.minimize(distance, rng.normal(size=32), method="BFGS").fun for _ in range(2))
        assert np.sum((estimate[:, p] - m[:, p]) ** 2) == pytest.approx(best, rel=1e-4)
    physical = np.stack([pure(rng, 0.7) for _ in range(5)]).reshape(5, 16).T
    np.testing.assert_allclose(nearest(physical), physical, atol=1e-12)
    physical[3, 1] = np.nan
    assert np.isnan(nearest(physical)[:, 1]).all()


def test_most_likely_beats_every_other_physical_matrix() -> None:
    rng = np.random.default_rng(4)
    a = rng.normal(size=(6, 40, 16))
    information = np.einsum("pni,pn,pnj->pij", a, rng.uniform(0.2, 5, (6, 40)), a) * 400
    m = np.stack([pure(rng, 1.0).reshape(16) for _ in range(6)])
    m += np.stack([rng.multivariate_normal(np.zeros(16), np.linalg.inv(f)) for f in information])
    packed = information[:, PACKED_ROW, PACKED_COLUMN].T
    estimate = most_likely(m.T, packed).T
    assert np.all(smallest_eigenvalue(estimate.T) > -1e-9)

    def loss(x: np.ndarray, p: int) -> float:
        return float((x - m[p]) @ information[p] @ (x - m[p]))

    for p in range(6):

        def parametrized(x: np.ndarray, p: int = p) -> float:
            factor = (x[:16] + 1j * x[16:]).reshape(4, 4)
            return loss(mueller.coherency_to_mueller(factor @ factor.conj().T).reshape(16), p)

        values, vectors = np.linalg.eigh(mueller.coherency(estimate[p].reshape(4, 4)))
        root = vectors * np.sqrt(np.maximum(values, 1e-6))
        start = np.concatenate([root.real.reshape(16), root.imag.reshape(16)])
        best = scipy.optimize.minimize(parametrized, start, method="BFGS").fun
        assert loss(estimate[p], p) <= best + 0.01
        assert loss(estimate[p], p) <= loss(nearest(m[p][:, None])[:, 0], p)


@pytest.mark.parametrize("physical", ["nearest", "likelihood"])
def test_physical_estimate_stands_beside_the_plain_one(
    physical: str, rgb950: InstrumentModel, synthetic_capture
) -> None:
    rng = np.random.default_rng(5)
    m = np.broadcast_to(1500 * pure(rng, 0.99)[..., None, None], (4, 4, 10, 12))
    path = capture_of(m, rng, rgb950, synthetic_capture)
    plain = reduced(path, rgb950, choice=Choice(weighted=True))
    image = reduced(path, rgb950, choice=Choice(weighted=True, physical=physical))
    np.testing.assert_array_equal(image.values, plain.values)
    with Product(path.with_suffix(".product.h5")) as product:
        estimate = product.get("mueller_physical")
    assert np.all(smallest_eigenvalue(estimate.reshape(16, -1)) > -1e-3)
    assert np.mean((estimate - m) ** 2) < np.mean((plain.values - m) ** 2)


def test_weights_and_covariance_with_a_retardance_that_varies(rgb950, synthetic_capture) -> None:
    """Each pixel against numpy with W of its place; a saturated intensity does not count."""
    values = {"x": 9.0, "y": -6.0, "x2": 3.0, "xy": 1.0, "y2": 0.0}
    parameters = {name: EffectParameter(value=value, unit="degree") for name, value in values.items()}
    field = AppliedEffect(kind="field_retardance", element="psa_retarder", parameters=parameters)
    model = rgb950.model_copy(update={"effects": (field,)})
    rng, shape = np.random.default_rng(8), (5, 7)
    truth = pure(rng).reshape(16)
    matrices = np.empty((*shape, 40, 16))
    for (r, c), y, x in ((at, 2 * at[0] / 4 - 1, 2 * at[1] / 6 - 1) for at in np.ndindex(shape)):
        extra = 9 * x - 6 * y + 3 * (x * x - 1 / 3) + x * y
        plate = rgb950.analyzer[0].model_copy(update={"retardance_deg": rgb950.analyzer[0].retardance_deg + extra})
        local = rgb950.model_copy(update={"analyzer": (plate, rgb950.analyzer[1])})
        matrices[r, c] = local.rows(ANGLES)[:, 0]
    signal = np.moveaxis(matrices @ truth, -1, 0)[:, None] * 3000
    counts = rng.poisson(np.maximum(signal, 0) * GAIN) / GAIN + rng.normal(0, READ / GAIN, signal.shape) + BLACK
    counts[3, 0, 2, 2] = 65535
    path = synthetic_capture(np.clip(np.rint(counts), 0, 65535).astype(np.uint16), ANGLES, detector=DETECTOR)
    out = path.with_suffix(".w.h5")
    with Capture(path) as capture:
        choice = Choice(weighted=True, covariance=True, physical="likelihood")
        reduce_mueller(capture, model, out, (Step("reduce", {}),), choice=choice)
        region, _ = MuellerReduction.of(capture, model, choice=choice).region(capture, slice(2, 3), slice(5, 6))
    image = MuellerImage.load(out)
    np.testing.assert_allclose(region.values[..., 0, 0], image.values[..., 2, 5], atol=0.01)
    with Product(out) as product:
        packed = product.get("mueller_covariance")
    y = np.rint(counts)[:, 0] - BLACK
    for r, c in ((0, 0), (2, 2), (4, 6)):
        w, keep = matrices[r, c], np.ones(40)
        if (r, c) == (2, 2):
            keep[3] = 0
        fitted = w @ np.linalg.lstsq(w * keep[:, None], y[:, r, c] * keep, rcond=None)[0]
        floor = (READ / GAIN) ** 2 + 1 / 12
        weight = keep / np.maximum(fitted / GAIN + floor, floor / 2)
        covariance = np.linalg.inv(w.T @ (weight[:, None] * w))
        expected = covariance @ w.T @ (weight * y[:, r, c])
        np.testing.assert_allclose(image.values[..., r, c].ravel(), expected, atol=0.2)
        np.testing.assert_allclose(packed[:, r, c], covariance[PACKED_ROW, PACKED_COLUMN], rtol=0.01, atol=0.05)
    assert np.isfinite(image.values).all()
