"""Material constants from Mueller images and from light behind polarizers: recovery, error bars, identifiability."""

from dataclasses import replace

import numpy as np
import pytest
from noisy_images import noisy_image

from processing.errors import NotDetermined
from processing.geometry.frames import ScatteringGeometry
from processing.instrument.states import rotating_retarders
from processing.maps.material_fit import covariance_by_light, determined_values
from processing.polarization.cloude import xi0_and_dominant
from processing.polarization.mueller import coherency, coherency_to_mueller
from processing.reduction.sent_light import sent_rows
from processing.reflectance.fitted_constants import MaterialFit
from processing.reflectance.material_fit import DIFFUSE, fit_values
from processing.reflectance.polarized_diffuse import Model
from simulators.bench.scene import Scene

NAMES = DIFFUSE.names
TRUE = np.array([1.3, 0.08, 0.17, 2.0])
VERTICAL = np.array([1.0, -1, 0, 0]) / 2


@pytest.fixture(scope="module")
def sphere(configs) -> tuple[ScatteringGeometry, np.ndarray]:
    """Geometry and true Mueller matrices of the red sphere at 662 nm, four arm angles."""
    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    parts, matrices = [], []
    for omega in (20, 35, 60, 90):
        truth = scene.truth(omega, 662, 30, 30)
        parts.append(truth.geometry.points)
        matrices.append(scene.mueller_image(omega, 662, 30, 30)[truth.mask].astype(float))
    vectors = (np.concatenate([getattr(p, name) for p in parts]) for name in ("normal", "to_source", "to_camera"))
    return ScatteringGeometry(*vectors), np.concatenate(matrices)


@pytest.fixture(scope="module")
def w40(rgb950) -> np.ndarray:
    return rgb950.rows(rotating_retarders(1.0).angles_deg).reshape(-1, 16)


def stokes(generator: np.ndarray) -> np.ndarray:
    analyzers = np.array([[1.0, 1, 0, 0], [1, 0, 1, 0], [1, -1, 0, 0], [1, 0, -1, 0]]) / 2
    return (analyzers[:, :, None] * generator).reshape(4, 16)


def by_noise(fit: MaterialFit) -> np.ndarray:
    """Standard errors without those of small eigenvalues that differ: these spheres have equal ones."""
    return np.sqrt(np.diag(fit.covariance))


def fit_matrices(geometry: ScatteringGeometry, m: np.ndarray) -> MaterialFit:
    return fit_values(geometry, m.reshape(-1, 16).T, np.eye(16), np.tile(np.eye(16), (len(m), 1, 1)))


def fit_intensities(geometry: ScatteringGeometry, p: np.ndarray, w: np.ndarray, variance: np.ndarray) -> MaterialFit:
    """To intensities (K, N) under W (K, 16), of variance (K, N) each."""
    return fit_values(geometry, p, w, variance.T[:, :, None] * np.eye(len(w)))


def test_exact_data_give_the_constants(sphere, w40):
    geometry, m = sphere
    fit = fit_matrices(geometry, m)
    np.testing.assert_allclose(fit.constants, TRUE, rtol=1e-4)
    for w in (stokes(VERTICAL), w40):
        p = w @ m.reshape(-1, 16).T
        fit = fit_values(geometry, p, w, np.tile(np.eye(len(w)), (len(m), 1, 1)), correlation=True)
        np.testing.assert_allclose(fit.constants, TRUE, rtol=2e-3)
        assert fit.correlation == pytest.approx(1, abs=1e-6)
        # Of a linear Stokes vector, small eigenvalues 3 % apart change n by a third of n - 1.
        assert fit.identified["n"] == (w is w40)


def noisy(m: np.ndarray, w: np.ndarray, seed: int, electrons: float) -> tuple[np.ndarray, np.ndarray]:
    p = electrons * (w @ m.reshape(-1, 16).T)
    variance = p + 6
    return p + np.random.default_rng(seed).normal(size=p.shape) * np.sqrt(variance), variance


@pytest.mark.parametrize(("angles", "electrons"), [(1, 200), (4, 20_000)])
def test_a_mueller_image_gives_constants_without_noise_bias(sphere, angles, electrons):
    geometry, m = sphere
    chosen = np.s_[:380] if angles == 1 else np.s_[::3]
    geometry, m = geometry[chosen], m[chosen] / m[chosen, 0, 0].mean()
    pulls = []
    for seed in range(5):
        image = noisy_image(m, electrons, seed)
        values, rows = determined_values(image)
        fit = fit_values(geometry, values, rows, covariance_by_light(image, rows))
        pulls.append((fit.constants - TRUE) / by_noise(fit))
    # Of 5 draws of 4 correlated values.
    assert np.abs(np.nanmean(pulls, axis=0)).max() < 1.5
    assert 0.5 < np.sqrt(np.nanmean(np.square(pulls))) < 1.6


#: Sides of partial polarimeters: what the generator sends and what the analyzer looks for.
LINEAR = np.array([[1, np.cos(x), np.sin(x), 0] for x in np.deg2rad([0.0, 90, 180, 270])]) / 2
SPHERE = np.array([[1, *v] for v in np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)]) / 2
PARTIAL = {
    "3 x 3": (LINEAR, LINEAR),
    "3 x 4": (SPHERE, LINEAR),
    "4 x 3": (LINEAR, SPHERE),
    "Stokes under light at 45 degrees": (np.array([[1.0, 0, 1, 0]]) / 2, SPHERE),
}


def partial_image(m, electrons, seed, generator, analyzer):
    """Image of a partial polarimeter, as `process reduce` leaves it."""
    w = (np.tile(analyzer, (2, 1))[:, None, :, None] * generator[:, None, :]).reshape(-1, 16)
    image = noisy_image(m, electrons, seed, w)
    spans = [np.abs(side).max(axis=0) > 0 for side in (analyzer, generator)]
    facts = {"weighted": False, "rank": np.linalg.matrix_rank(w)}
    if len(generator) == 1:
        sent = sent_rows(w) @ image.values.reshape(16, -1)
        sent[~spans[0]] = np.nan
        unknown = np.full_like(image.values, np.nan)
        facts["determined"] = "S0, S1, S2"
        return replace(image, values=unknown, errors=unknown, sent=sent[:, None].astype(np.float32), facts=facts)
    is_determined = np.outer(*spans).reshape(16)
    facts["determined"] = ", ".join(f"m{k // 4}{k % 4}" for k in np.flatnonzero(is_determined))
    return replace(image, facts=facts)


def partial_fit(sphere, sides, electrons, seed):
    geometry, m = sphere
    image = partial_image(m[::4] / m[::4, 0, 0].mean(), electrons, seed, *sides)
    values, rows = determined_values(image)
    return fit_values(geometry[::4], values, rows, covariance_by_light(image, rows))


@pytest.mark.parametrize("name", PARTIAL)
def test_partial_polarimeters_give_constants_without_noise_bias(sphere, name):
    fits = [partial_fit(sphere, PARTIAL[name], 8000, seed) for seed in range(5)]
    pulls = [(fit.constants - TRUE) / by_noise(fit) for fit in fits]
    assert np.abs(np.nanmean(pulls, axis=0)).max() < 1.5
    assert 0.5 < np.sqrt(np.nanmean(np.square(pulls))) < 1.6
    assert all(fit.identified["n"] and fit.identified["a"] and fit.identified["b"] for fit in fits)


def test_unpolarized_light_does_not_pretend_to_tell_what_it_cannot(sphere):
    # Here n and k run into their bounds, and what is fitted beside them is far from the truth.
    fits = [partial_fit(sphere, (np.array([[0.5, 0, 0, 0]]), SPHERE), 500, seed) for seed in range(3)]
    pulls = [
        [(fit.constants[k] - TRUE[k]) / fit.stderr[k] for k in range(4) if fit.identified[NAMES[k]]] for fit in fits
    ]
    assert np.abs(np.concatenate(pulls)).max(initial=0) < 4
    assert not any(fit.identified["k"] or fit.identified["a"] for fit in fits)


def test_standard_errors_of_a_stokes_fit_cover_the_truth(sphere):
    geometry, m = sphere[0][::3], sphere[1][::3]
    pulls = []
    for seed in range(12):
        p, variance = noisy(m, stokes(VERTICAL), seed, 200_000)
        fit = fit_intensities(geometry, p, stokes(VERTICAL), variance)
        pulls.append((fit.constants - TRUE) / by_noise(fit))
    # 12 draws of 4 correlated values: the spread of a unit variance estimate is about 0.2.
    assert np.nanstd(pulls) == pytest.approx(1, abs=0.5)
    assert np.abs(np.nanmean(pulls, axis=0)).max() < 1.2


def test_correlated_values_fit_like_the_intensities_that_they_come_from(sphere):
    geometry, m = sphere
    w = stokes(VERTICAL)
    p, variance = noisy(m, w, 0, 200_000)
    mix = np.random.default_rng(0).normal(size=(4, 4))
    covariance = np.einsum("ik,kn,jk->nij", mix, variance, mix)
    mixed = fit_values(geometry, mix @ p, mix @ w, covariance)
    plain = fit_intensities(geometry, p, w, variance)
    np.testing.assert_allclose(mixed.constants, plain.constants, rtol=1e-4)
    np.testing.assert_allclose(mixed.stderr, plain.stderr, rtol=1e-2)


def test_what_the_data_do_not_fix_is_said(sphere):
    geometry, m = sphere
    # Near specular the diffuse term has no weight: a and b cannot be had there.
    near = geometry.angles.theta_h < np.deg2rad(12)
    p, variance = noisy(m[near], stokes(VERTICAL), 0, 20_000)
    fit = fit_intensities(geometry[near], p, stokes(VERTICAL), variance)
    assert not fit.identified["b"]
    with pytest.raises(NotDetermined, match="10"):
        fit_matrices(geometry, np.full((len(m), 4, 4), np.nan))


@pytest.mark.parametrize("seed", range(3))
def test_what_is_fitted_beside_an_n_that_is_not_fixed_is_not_identified(sphere, seed):
    """Its error to first order is about an n that may be another: of 55 images b was inside in 86 %, 4 errors off."""
    geometry, m = sphere[0][380:760], sphere[1][380:760]
    p, variance = noisy(m / m[:, 0, 0].mean(), stokes(VERTICAL), seed, 12_000)
    fit = fit_intensities(geometry, p, stokes(VERTICAL), variance)
    assert fit.stderr[3] < 0.3 * fit.constants[3]
    assert not any(fit.identified.values())


@pytest.mark.parametrize("seed", [2, 3, 6])
def test_a_k_at_its_bound_identifies_nothing(sphere, seed):
    """n was 1.43 +- 0.05 where it is 1.69: linear light sees k by its square, errors at k = 0 have no share of it."""
    geometry = sphere[0][::2]
    constants = {662.0: {"n": 1.686, "k": 0.08, "a": 0.387, "b": 1.236}}
    material = Model(name="test", source="test", constants=constants)
    m = 0.6 * material.mueller_jones(geometry, 662)
    m[:, 0, 0] = 1
    p, variance = noisy(apart(m, np.random.default_rng(seed), 0.04), stokes(VERTICAL), seed, 4000)
    fit = fit_intensities(geometry, p, stokes(VERTICAL), variance)
    assert fit.constants[1] == pytest.approx(0, abs=1e-3)
    assert not any(fit.identified.values())


def test_a_turned_geometry_lowers_the_correlation(sphere):
    geometry, m = sphere
    w = stokes(VERTICAL)
    p = w @ m.reshape(-1, 16).T
    right = fit_intensities(geometry, p, w, np.ones_like(p)).correlation
    wrong = ScatteringGeometry(np.roll(geometry.normal, 40, axis=0), geometry.to_source, geometry.to_camera)
    fit = fit_intensities(wrong, p, w, np.ones_like(p))
    assert fit.correlation < right - 0.02
    assert not all(fit.identified.values())


def test_the_fitted_model_is_a_material(sphere):
    geometry, m = sphere
    m0 = xi0_and_dominant(m)[1]
    fit = fit_matrices(geometry, m)
    model = fit.model("mine", 662)
    np.testing.assert_allclose(model.mueller_jones(geometry, 662), m0, atol=1e-4)
    assert tuple(fit.identified) == NAMES


def apart(m: np.ndarray, rng: np.random.Generator, size: float = 0.05) -> np.ndarray:
    """These matrices with small eigenvalues 5 % apart, in processes drawn at random that vary with the geometry."""
    m0 = xi0_and_dominant(m)[1]
    jones = np.linalg.eigh(coherency(m0))[1][..., -1].reshape(-1, 2, 2)
    seeds = [jones, *(jones @ (rng.normal(size=(2, 2)) + 1j * rng.normal(size=(2, 2))) for _ in range(3))]
    remainder = np.linalg.qr(np.stack([s.reshape(-1, 4) for s in seeds], axis=2))[0][..., 1:]
    processes = coherency_to_mueller(2 * np.einsum("nik,njk->nkij", remainder, remainder.conj()))
    return m + m[:, :1, :1] * np.einsum("k,nkij->nij", [size / 2, 0.0, -size / 2], processes)


@pytest.mark.parametrize("seed", range(3))
def test_a_stokes_image_does_not_claim_constants_that_small_eigenvalues_move(sphere, seed):
    """They vary over the surface: 0.7 % apart, they moved n from 1.30 to 1.16, at a stated error of 0.03."""
    geometry, m = sphere[0][::2], sphere[1][::2]
    rng = np.random.default_rng(seed)
    p, variance = noisy(apart(m / m[:, 0, 0].mean(), rng, rng.uniform(0.003, 0.03)), stokes(VERTICAL), seed, 68_000)
    fit = fit_intensities(geometry, p, stokes(VERTICAL), variance)
    identified = [k for k, name in enumerate(NAMES) if fit.identified[name]]
    assert np.all(np.abs(fit.constants - TRUE)[identified] < 3 * fit.stderr[identified])


@pytest.mark.long
@pytest.mark.parametrize("electrons", [200, 20_000])
def test_small_eigenvalues_that_differ_do_not_move_the_constants(sphere, electrons):
    """Linear correlation is off by tens of its errors of noise there; its interval knows, and its chi-square."""
    geometry, m = sphere[0][::2], sphere[1][::2]
    rng = np.random.default_rng(electrons)
    pulls, wrong, total = [], [], []
    for seed in range(12):
        image = noisy_image(apart(m / m[:, 0, 0].mean(), rng), electrons, seed)
        values, rows = determined_values(image)
        data = geometry, values, rows, covariance_by_light(image, rows)
        fit, correlated = fit_values(*data), fit_values(*data, correlation=True)
        assert fit.describes
        assert all(fit.identified.values())
        pulls.append((fit.constants - TRUE) / fit.stderr)
        wrong.append((correlated.constants - TRUE) / fit.stderr)
        total.append((correlated.constants - TRUE) / correlated.stderr)
        assert electrons == 200 or not correlated.describes
    # Of 12 draws of 4 correlated values: the rms of their pulls is known to 0.17.
    assert 0.55 < np.sqrt(np.mean(np.square(pulls))) < 1.45
    assert np.abs(np.mean(pulls, axis=0)).max() < 1.1
    assert np.sqrt(np.mean(np.square(wrong))) > (1 if electrons == 200 else 10)
    assert np.sqrt(np.mean(np.square(total))) < 1.5


def test_a_surface_of_another_kind_is_not_described(sphere):
    geometry, m = sphere[0][::2], sphere[1][::2]
    turned = np.roll(m / m[:, 0, 0].mean(), 40, axis=0)
    image = noisy_image(turned, 20_000, 1)
    values, rows = determined_values(image)
    fit = fit_values(geometry, values, rows, covariance_by_light(image, rows))
    assert not fit.describes
    assert any("DOES NOT DESCRIBE" in note for note in fit.notes(["a"]))
