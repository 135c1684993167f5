"""Lu-Chipman, symmetric and differential decompositions: analytic cases, rebuilt matrices, and others' packages.

tests/physics/peer_decompositions.json holds what py_pol 1.3.0, muellerkit 0.1.2, katsu 0.1.0 and pymueller 0.1.3 answer
for 16 matrices (benchmarks/peer_decompositions.py of commit 6022f66 asked them). Conventions:
- det M > 0: py_pol, muellerkit, katsu give our three factors. pymueller returns scalars only; its diattenuation agrees,
  its other numbers differ from all, because it builds MD from D D^T without dividing by |D|^2.
- det M < 0: muellerkit keeps det MR = +1 with a negative depolarizer, as we do. katsu tests the sign of det(m m^T),
  never negative, and returns a positive depolarizer with det MR = -1. py_pol turns the sign of the whole retarder,
  its first element too, so that its product is not M.
- py_pol calls sqrt(1 - DI^2) the depolarization index.
- py_pol's covariance matrix has trace m00, muellerkit's coherency matrix trace 1: the same eigenvalues for m00 = 1.
No package on the index has the symmetric or the differential decomposition; scipy's logarithm stands in for the latter.
"""

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from random_matrices import random_mueller
from scipy.linalg import expm, logm

from processing.polarization import mueller, quantities
from processing.polarization.cloude import coherency_eigenvalues
from processing.polarization.decompositions.differential import differential
from processing.polarization.decompositions.lu_chipman import depolarization_power, lu_chipman
from processing.polarization.decompositions.symmetric import G, symmetric

Array = NDArray[np.float64]


@pytest.fixture(scope="module")
def peers() -> dict[str, Any]:
    results: dict[str, Any] = json.loads((Path(__file__).parent / "peer_decompositions.json").read_text())
    return results


class TestOthersPackages:
    def test_lu_chipman_of_positive_determinants(self, peers: dict[str, Any]) -> None:
        m = np.array(peers["matrices"])
        factors = lu_chipman(m)
        good = np.linalg.det(m) > 0
        assert good.sum() == 12
        for package in ("py_pol", "muellerkit"):
            for factor in ("depolarizer", "retarder", "diattenuator"):
                peer = np.array(peers["packages"][package][factor])
                np.testing.assert_allclose(getattr(factors, factor)[good], peer[good], atol=4e-13)
        katsu = np.array(peers["packages"]["katsu"]["factors"])
        for k, factor in enumerate(("depolarizer", "retarder", "diattenuator")):
            np.testing.assert_allclose(getattr(factors, factor)[good], katsu[good, k], atol=4e-13)
        d = quantities.magnitude(quantities.diattenuation_vector(m))
        np.testing.assert_allclose(d, peers["packages"]["pymueller"]["answers"][0], atol=1e-14)

    def test_lu_chipman_of_negative_determinants(self, peers: dict[str, Any]) -> None:
        m = np.array(peers["matrices"])
        factors = lu_chipman(m)
        bad = factors.negative_determinant
        assert bad.sum() == 4
        kit = peers["packages"]["muellerkit"]
        for factor in ("depolarizer", "retarder", "diattenuator"):
            np.testing.assert_allclose(getattr(factors, factor)[bad], np.array(kit[factor])[bad], atol=4e-13)
        katsu = np.array(peers["packages"]["katsu"]["factors"])
        np.testing.assert_allclose(np.linalg.det(katsu[bad, 1]), -1, atol=1e-9)
        np.testing.assert_allclose(katsu[bad, 1, 1:, 1:], -factors.retarder[bad, 1:, 1:], atol=1e-9)
        py_pol = np.array(peers["packages"]["py_pol"]["retarder"])
        np.testing.assert_allclose(py_pol[bad], -factors.retarder[bad], atol=1e-9)

    def test_scalars(self, peers: dict[str, Any]) -> None:
        m = np.array(peers["matrices"])
        factors, packages = lu_chipman(m), peers["packages"]
        retardance = quantities.magnitude(quantities.retardance_vector(factors.retarder))
        np.testing.assert_allclose(retardance, packages["muellerkit"]["total_retardance_rad"], atol=1e-12)
        power = depolarization_power(factors.depolarizer)
        np.testing.assert_allclose(power, packages["muellerkit"]["depolarization_power"], atol=1e-12)
        index = np.sqrt(1 - quantities.depolarization_index(m) ** 2)
        np.testing.assert_allclose(index, packages["py_pol"]["depolarization_index"], atol=1e-12)

    def test_coherency_eigenvalues(self, peers: dict[str, Any]) -> None:
        xi = coherency_eigenvalues(np.array(peers["matrices"]))
        np.testing.assert_allclose(xi, peers["packages"]["py_pol"]["covariance_eigenvalues"], atol=1e-14)
        np.testing.assert_allclose(xi, peers["packages"]["muellerkit"]["coherency_eigenvalues"], atol=1e-14)


class TestLuChipman:
    def test_factors_are_what_they_say_and_give_m_back(self) -> None:
        m = random_mueller(4000, seed=1)
        factors = lu_chipman(m)
        assert factors.defined.all()
        np.testing.assert_array_equal(factors.negative_determinant, np.linalg.det(m) < 0)
        assert 10 < factors.negative_determinant.sum() < 400
        rebuilt = factors.depolarizer @ factors.retarder @ factors.diattenuator
        np.testing.assert_allclose(rebuilt, m, atol=1e-11 * m.max())
        r = factors.retarder[:, 1:, 1:]
        np.testing.assert_allclose(r @ np.swapaxes(r, 1, 2), np.broadcast_to(np.eye(3), r.shape), atol=1e-13)
        np.testing.assert_allclose(np.linalg.det(r), 1, atol=1e-13)
        np.testing.assert_array_equal(factors.depolarizer[:, 0], np.broadcast_to([1, 0, 0, 0], (len(m), 4)))
        block = factors.depolarizer[:, 1:, 1:]
        np.testing.assert_array_equal(block, np.swapaxes(block, 1, 2))
        axes = np.linalg.eigvalsh(block)
        assert (np.where(factors.negative_determinant[:, None], -axes, axes) > -1e-12).all()
        np.testing.assert_allclose(factors.diattenuator, np.swapaxes(factors.diattenuator, 1, 2))
        np.testing.assert_allclose(coherency_eigenvalues(factors.diattenuator)[:, 0], 1, atol=1e-10)

    def test_known_products(self) -> None:
        retarder = mueller.retarder(0.3, 2.0) @ mueller.rotation(0.2)
        diattenuator = mueller.diattenuator(1.1, 0.9, 0.2)
        depolarizer = np.array([[1, 0, 0, 0], [0.1, 0.5, 0.1, 0], [0.05, 0.1, 0.4, 0], [0, 0, 0, 0.3]])
        factors = lu_chipman(depolarizer @ retarder @ diattenuator)
        np.testing.assert_allclose(factors.depolarizer, depolarizer, atol=1e-13)
        np.testing.assert_allclose(factors.retarder, retarder, atol=1e-13)
        np.testing.assert_allclose(factors.diattenuator, diattenuator, atol=1e-13)
        np.testing.assert_allclose(depolarization_power(factors.depolarizer), 1 - 1.2 / 3)

    def test_depolarization_does_not_lower_the_retardance(self) -> None:
        # docs/conventions.md, "Below a quarter"
        for xi0 in (0.3, 0.6, 1.0):
            m = 4 / 3 * ((xi0 - 0.25) * mueller.retarder(0.3, 1.3) + (1 - xi0) * mueller.IDEAL_DEPOLARIZER)
            vector = quantities.retardance_vector(lu_chipman(m).retarder)
            np.testing.assert_allclose(quantities.magnitude(vector), 1.3, atol=1e-12)

    def test_where_it_is_not_defined(self) -> None:
        invalid = np.full((4, 4), np.nan)
        cases = np.stack([mueller.polarizer(0.3), mueller.IDEAL_DEPOLARIZER, np.zeros((4, 4)), invalid, np.eye(4)])
        factors = lu_chipman(cases)
        np.testing.assert_array_equal(factors.defined, [False, False, False, False, True])
        assert np.isnan(factors.retarder[:4]).all()
        assert np.isnan(factors.depolarizer[:4]).all()
        assert not factors.negative_determinant[:4].any()
        # The ideal depolarizer has a diattenuator all the same.
        np.testing.assert_allclose(factors.diattenuator[1], np.eye(4))

    def test_nearly_singular_depolarizers(self) -> None:
        retarder = mueller.retarder(0.7, 2.9) @ mueller.rotation(-0.5)
        depolarizer = np.diag([1.0, 0.5, 1e-6, 1e-3])
        factors = lu_chipman(depolarizer @ retarder)
        np.testing.assert_allclose(factors.retarder, retarder, atol=1e-9)
        np.testing.assert_allclose(factors.depolarizer, depolarizer, atol=1e-12)

    def test_planar_single_precision_images(self) -> None:
        m = random_mueller(60 * 300, seed=9).reshape(60, 300, 4, 4)
        planar = np.ascontiguousarray(np.moveaxis(m, (-2, -1), (0, 1)).astype(np.float32))
        single, double = lu_chipman(np.moveaxis(planar, (0, 1), (-2, -1))), lu_chipman(m)
        assert single.retarder.dtype == np.float32
        assert single.retarder.shape == (60, 300, 4, 4)
        np.testing.assert_allclose(
            single.diattenuator / m[..., :1, :1], double.diattenuator / m[..., :1, :1], atol=1e-5
        )
        worst = np.abs(single.retarder - double.retarder).max(axis=(-2, -1))
        assert np.quantile(worst, 0.99) < 1e-4

    @settings(max_examples=40, deadline=None)
    @given(st.integers(0, 2**31), st.floats(-3, 3))
    def test_turning_the_frame_turns_every_factor(self, seed: int, angle: float) -> None:
        m = random_mueller(4, seed)
        forth, back = mueller.rotation(angle), mueller.rotation(-angle)
        plain, turned = lu_chipman(m), lu_chipman(forth @ m @ back)
        size = np.linalg.svd(plain.depolarizer[:, 1:, 1:], compute_uv=False)[:, -1]
        for factor in ("depolarizer", "retarder", "diattenuator"):
            expected = forth @ getattr(plain, factor) @ back
            difference = np.abs(getattr(turned, factor) - expected).max(axis=(-2, -1))
            assert (difference < 1e-12 * m.max() / np.minimum(size, 1)).all()


class TestSymmetric:
    def test_factors_are_what_they_say_and_give_m_back(self) -> None:
        m = random_mueller(800, seed=3)
        factors = symmetric(m)
        assert factors.defined.mean() > 0.99
        m, factors = m[factors.defined], type(factors)(*(f[factors.defined] for f in factors))
        retarder_1 = np.swapaxes(factors.retarder_1, 1, 2)
        rebuilt = (
            factors.diattenuator_2 @ factors.retarder_2 @ factors.depolarizer @ retarder_1 @ factors.diattenuator_1
        )
        np.testing.assert_allclose(rebuilt, m, atol=1e-7 * m.max())
        for retarder in (factors.retarder_1, factors.retarder_2):
            np.testing.assert_allclose(np.linalg.det(retarder), 1, atol=1e-12)
        d = np.diagonal(factors.depolarizer, axis1=1, axis2=2)
        assert (np.diff(np.abs(d), axis=1) <= 1e-9 * m.max()).all()
        np.testing.assert_array_equal(d[:, 3] < 0, np.linalg.det(m) < 0)

    def test_known_product(self) -> None:
        diattenuator_1, diattenuator_2 = (
            mueller.diattenuator(0.3, 1.0, 0.4) / 0.7,
            mueller.diattenuator(1.0, 1, 0.7) / 0.85,
        )
        retarder_1 = mueller.retarder(0.2, 0.9)
        retarder_2 = mueller.rotation(0.25) @ mueller.retarder(-0.4, 0.4)
        depolarizer = np.diag([2.0, 1.4, 1.0, 0.4])
        m = diattenuator_2 @ retarder_2 @ depolarizer @ retarder_1.T @ diattenuator_1
        factors = symmetric(m)
        assert factors.defined
        np.testing.assert_allclose(factors.diattenuator_1, diattenuator_1, atol=1e-12)
        np.testing.assert_allclose(factors.diattenuator_2, diattenuator_2, atol=1e-12)
        np.testing.assert_allclose(factors.depolarizer, depolarizer, atol=1e-12)
        # Turning a common principal axis by pi in both retarders changes nothing, so compare what acts.
        np.testing.assert_allclose(
            factors.retarder_2 @ factors.depolarizer @ factors.retarder_1.T,
            retarder_2 @ depolarizer @ retarder_1.T,
            atol=1e-12,
        )

    def test_where_it_is_not_defined(self) -> None:
        unphysical = np.diag([1.0, 1.0, 1.0, 1.0])
        unphysical[0, 1] = 3.0
        # Stokes-non-diagonalizable: the eigenvector of m^T G m G lies on the light cone.
        jordan = np.array([[2.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
        pure = mueller.retarder(0.3, 1.0) @ mueller.diattenuator(0.1, 1, 0.5)
        cases = np.stack([mueller.polarizer(0.3), np.full((4, 4), np.nan), np.zeros((4, 4)), unphysical, jordan, pure])
        factors = symmetric(cases)
        assert not factors.defined.any()
        assert np.isnan(factors.depolarizer).all()


class TestDifferential:
    def test_agrees_with_the_plain_matrix_logarithm(self) -> None:
        m = random_mueller(200, seed=4)
        generators = differential(m)
        assert 0.5 < generators.defined.mean() < 1
        for k in np.flatnonzero(generators.defined):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)  # scipy's own estimate, at 2e-13
                logarithm = np.real(logm(m[k]))
            np.testing.assert_allclose(generators.mean[k] + generators.fluctuation[k], logarithm, atol=1e-8)
            np.testing.assert_allclose(
                expm(generators.mean[k] + generators.fluctuation[k]), m[k], atol=1e-8 * m[k].max()
            )
        values = np.linalg.eigvals(m[~generators.defined])
        assert ((np.abs(values.imag) < 1e-9) & (values.real < 0)).any(axis=-1).all()

    def test_symmetry_of_the_parts(self) -> None:
        generators = differential(random_mueller(100, seed=5))
        mean, fluctuation = generators.mean[generators.defined], generators.fluctuation[generators.defined]
        diagonal = mean[:, :1, :1] * np.eye(4)
        np.testing.assert_allclose(mean - diagonal, -G @ np.swapaxes(mean - diagonal, 1, 2) @ G, atol=1e-12)
        np.testing.assert_allclose(fluctuation, G @ np.swapaxes(fluctuation, 1, 2) @ G, atol=1e-12)
        np.testing.assert_allclose(fluctuation[:, 0, 0], 0, atol=1e-14)

    def test_uniform_medium_with_retardance_diattenuation_and_depolarization(self) -> None:
        # dM/dz = l M over unit length: the decomposition must give l back.
        retardance, diattenuation = np.array([0.6, -0.3, 0.5]), np.array([0.2, 0.1, -0.15])
        l_matrix = np.zeros((4, 4))
        l_matrix[0, 1:] = l_matrix[1:, 0] = diattenuation
        for (i, j), value in zip([(2, 3), (3, 1), (1, 2)], retardance, strict=True):
            l_matrix[i, j], l_matrix[j, i] = value, -value
        decay = np.array([0.3, 0.5, 0.7])
        m = expm(l_matrix - np.diag([0.0, *decay]) - 0.4 * np.eye(4))
        generators = differential(m)
        assert generators.defined
        np.testing.assert_allclose(generators.retardance(), retardance, atol=1e-10)
        np.testing.assert_allclose(generators.diattenuation(), diattenuation, atol=1e-10)
        np.testing.assert_allclose(generators.depolarization(), decay, atol=1e-10)
        np.testing.assert_allclose(np.diag(generators.mean), -0.4, atol=1e-10)

    @pytest.mark.parametrize("azimuth", [0.0, 0.4, 1.3])
    def test_elements(self, azimuth: float) -> None:
        generators = differential(mueller.retarder(azimuth, 2.5) @ mueller.diattenuator(azimuth, 1.0, 0.3))
        axis = np.array([np.cos(2 * azimuth), np.sin(2 * azimuth), 0])
        np.testing.assert_allclose(generators.retardance(), 2.5 * axis, atol=1e-10)
        np.testing.assert_allclose(generators.diattenuation(), np.log(1 / 0.3) / 2 * axis, atol=1e-10)
        np.testing.assert_allclose(generators.fluctuation, 0, atol=1e-10)

    def test_defective_matrix(self) -> None:
        # Retardance and diattenuation of equal strength, crossed by 45 degrees: a null rotation, one eigenvector short.
        l_matrix = np.zeros((4, 4))
        l_matrix[0, 1] = l_matrix[1, 0] = 0.5
        l_matrix[1, 3], l_matrix[3, 1] = 0.5, -0.5
        generators = differential(expm(l_matrix))
        assert generators.defined
        np.testing.assert_allclose(generators.mean, l_matrix, atol=1e-7)

    def test_where_it_is_not_defined(self) -> None:
        invalid = np.full((4, 4), np.nan)
        cases = [mueller.polarizer(0.3), mueller.IDEAL_MIRROR, mueller.retarder(0.2, np.pi), np.zeros((4, 4)), invalid]
        generators = differential(np.stack(cases))
        assert not generators.defined.any()
        assert np.isnan(generators.mean).all()
