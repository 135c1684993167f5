"""The paper's own story: a sphere at 662 nm, taken as first surface alone, lacks polarized diffuse reflection."""

import numpy as np
import pytest
from measured_points import ReflectanceProblem

from processing.diagnosis.search.causes import causes
from processing.diagnosis.search.fit import held_out
from processing.diagnosis.search.own_minima import OwnMinima
from processing.diagnosis.search.space import Space
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.polarization.xi0 import estimate
from simulators.bench.scene import Scene

WAVELENGTH_NM, OMEGA_DEG = 662.0, 35.0


@pytest.fixture(scope="module")
def sphere(configs):
    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    truth = scene.truth(OMEGA_DEG, WAVELENGTH_NM, 40, 40)
    m = np.asarray(scene.mueller_image(OMEGA_DEG, WAVELENGTH_NM, 40, 40), dtype=float)[truth.mask]
    w = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(WAVELENGTH_NM)
    w = w.rows(rotating_retarders(0.1).angles_deg).reshape(-1, 16)
    electrons = 20_000 * m.reshape(-1, 16) @ w.T / (m[:, 0, 0].max() * 0.25)
    noisy = np.random.default_rng(5).poisson(np.maximum(electrons, 0)).astype(float)
    return scene, truth, w, noisy, np.sqrt(np.maximum(electrons, 1.0))


def errors(model, true, intensities, w, xi0):
    """RMS errors of psi (degrees), of the relative |D| of m0, and of xi0."""

    def linear(m):
        return m[:, 0, 1], m[:, 0, 2]

    (a, b), (c, d) = linear(model), linear(true)
    turn = np.rad2deg(np.angle(np.exp(1j * (np.arctan2(b, a) - np.arctan2(d, c))))) / 2
    size, wanted = np.hypot(a, b), np.hypot(c, d)
    found = estimate(intensities.T, None, w, model).xi0
    parts = (turn, size - wanted, found - xi0)
    return [float(np.sqrt(np.nanmean(p**2))) for p in parts]


def test_first_surface_alone_lacks_polarized_diffuse(sphere):
    scene, truth, w, noisy, sigma = sphere
    points = truth.geometry.points
    constants = scene.material.constants[662]
    index = complex(constants.n, constants.k)
    problem = ReflectanceProblem(points, noisy, w, index, sigma)
    search = OwnMinima(problem, lambda line: None)
    found = search.run()
    assert [c.kind for c in found.space.candidates] == ["polarized_diffuse"]
    (cause,) = causes(search.posterior(found), 0.0)
    assert cause.answer == "sure"
    a, log_b = found.fit.values
    assert a == pytest.approx(constants.a, abs=0.02)
    assert np.exp(log_b) == pytest.approx(constants.b, abs=0.3)
    assert held_out(problem, found.space, found.fit).chi2_reduced < 1.02

    true = scene.material.mueller_jones(points, WAVELENGTH_NM)
    xi0 = truth.xi0[truth.mask]
    before = errors(problem.dominant(Space(()), np.zeros(0)), true, noisy, w, xi0)
    after = errors(problem.dominant(found.space, found.fit.values), true, noisy, w, xi0)
    limit = errors(true, true, noisy, w, xi0)
    print("psi deg, |D| of m0, xi0:", before, after, "noise alone:", limit)
    assert before[0] > 10
    assert after[0] < 0.1 * before[0]
    assert after[1] < 0.1 * before[1]
    # What is left of xi0's error is the noise of the intensities, which the true model has as well.
    assert after[2] < 1.05 * limit[2] < 0.8 * before[2]
