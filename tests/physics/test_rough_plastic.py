"""Two processes that add: against a renderer, fitted with error bars, and rendered back."""

import numpy as np
import pytest

from processing.errors import ProcessError
from processing.geometry.frames import ScatteringGeometry, unit
from processing.geometry.rusinkiewicz import directions
from processing.maps.material_fit import fit_products
from processing.polarization.cloude import coherency_eigenvalues
from processing.reflectance.base import load_reflectance
from processing.reflectance.material_fit import fit_values
from processing.reflectance.pbsdf import model_table
from processing.reflectance.plastic_fit import fit_plastic
from processing.reflectance.rough_plastic import Model, processes
from processing.reflectance.tables import TableError

TRUE = np.array([1.5, 0.3, 0.25])
VERTICAL = np.array([1.0, -1, 0, 0]) / 2

#: n, alpha, albedo, direction to the source and to the camera (normal on z), and BRDF times the cosine of incidence.
#: Of Mitsuba 3.9.1, `pplastic` with distribution "ggx" (scalar_spectral_polarized), turned to axes with up = y.
MITSUBA = [
    (
        (1.5, 0.4, 0.5),
        (-0.353805219, 0.702049939, 0.618019215),
        (0.491362639, -0.591070315, 0.63968636),
        (
            *(0.120603, -0.00594824, -0.0262803, 0, 0.00460266, 0.00950822, -0.0048776, 0),
            *(0.0269768, -0.00602683, -0.0332319, 0, 0, 0, 0, -0.0102183),
        ),
    ),
    (
        (1.7, 0.2, 0.8),
        (-0.099256759, -0.797860145, 0.59461524),
        (0.030973113, 0.595780011, 0.802550213),
        (
            *(0.207087, 0.0456543, 0.014323, 0, 0.0537188, 0.0779774, 0.0131205, 0),
            *(-0.0140241, -0.00215657, -0.0542024, 0, 0, 0, 0, -0.0521917),
        ),
    ),
    (
        (1.35, 0.2, 0.8),
        (-0.351748986, 0.62470482, 0.697148864),
        (0.874541615, -0.459198525, 0.15592844),
        (
            *(0.113826, -0.00837748, -0.000874972, 0, 0.0151257, 0.00250518, 0.00483393, 0),
            *(0.00449322, -0.00786703, -0.00242942, 0, 0, 0, 0, 0.00302729),
        ),
    ),
]


def plastic(n: float, alpha: float, albedo: float) -> Model:
    return Model(name="test", constants={662: {"n": n, "alpha": alpha, "albedo": albedo}})


@pytest.mark.parametrize(("constants", "to_source", "to_camera", "expected"), MITSUBA)
def test_the_brdf_is_that_of_a_renderer(constants, to_source, to_camera, expected):
    points = ScatteringGeometry(*(np.array([v], dtype=float) for v in ((0, 0, 1), to_source, to_camera)))
    brdf = plastic(*constants).brdf(points, 662)[0] * to_source[2]
    np.testing.assert_allclose(brdf.ravel(), expected, rtol=0, atol=5e-6 * brdf[0, 0])


def test_it_departs_from_triple_degeneracy():
    points = ScatteringGeometry(*directions(*np.deg2rad([[40.0], [30.0], [60.0]])))
    xi = coherency_eigenvalues(plastic(1.5, 0.3, 0.5).brdf(points, 662))[0]
    assert xi[1] - xi[3] > 0.02


def sphere(seed: int, count: int = 1500) -> ScatteringGeometry:
    """Random points of a sphere at four arm angles."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-0.9, 0.9, (count, 2))
    normal = unit(np.column_stack([x, np.sqrt(np.maximum(1 - (x**2).sum(axis=1), 0.1))]))
    omega = np.deg2rad(rng.choice([20, 35, 60, 85], count))
    source = np.column_stack([np.sin(omega), 0 * omega, np.cos(omega)])
    points = ScatteringGeometry(normal, source, np.tile([0.0, 0, 1], (count, 1)))
    return points[np.sum(normal * source, axis=1) > 0.1]


def measured(points: ScatteringGeometry, rows: np.ndarray, seed: int, electrons: float):
    """Values (K, N) with noise and their covariance, under uneven light."""
    rng = np.random.default_rng(seed + 1000)
    surface, volume = processes(points, TRUE[0], TRUE[1])
    m = (surface + TRUE[2] * volume).reshape(-1, 16) * rng.uniform(0.5, 1, (len(surface), 1)) * np.pi / TRUE[2]
    sigma = np.sqrt(electrons * m[:, 0] + 20)
    values = electrons * rows @ m.T + rng.normal(size=(len(rows), len(m))) * sigma
    return values, sigma[:, None, None] ** 2 * np.eye(len(rows))


@pytest.mark.parametrize("light", [pytest.param("mueller", marks=pytest.mark.long), "stokes"])
def test_constants_are_within_their_errors(light):
    rows = np.eye(16) if light == "mueller" else np.kron(np.eye(4)[:3], VERTICAL)
    z = []
    for seed in range(12):
        points = sphere(seed)
        values, covariance = measured(points, rows, seed, 2000)
        fit = fit_plastic(points, values, rows, covariance)
        assert fit.describes
        assert all(fit.identified.values())
        z.append((fit.constants - TRUE) / fit.stderr)
    # n and albedo go together (correlation 0.9): 36 pulls count as 24.
    assert 0.35 < np.mean(np.square(z)) < 2.1


def test_one_process_does_not_describe_two_and_says_so():
    points = sphere(3)
    values, covariance = measured(points, np.eye(16), 3, 20_000)
    fit = fit_values(points, values, np.eye(16), covariance)
    two = fit_plastic(points, values, np.eye(16), covariance)
    assert not fit.describes
    assert two.describes
    assert two.model("tile", 662).constants[662].n == pytest.approx(TRUE[0], abs=4 * two.stderr[0])


def test_an_analyzer_that_is_off_is_in_the_errors():
    points = sphere(5)
    values, covariance = measured(points, np.eye(16), 5, 1e7)
    turned = np.kron(rotation(0.01), np.eye(4)) @ values
    fit = fit_plastic(points, turned, np.eye(16), covariance, moved=[(values, np.eye(16))])
    assert np.all(np.abs(fit.constants - TRUE) < 3 * fit.stderr)
    assert np.any(fit.systematic)


def rotation(angle: float) -> np.ndarray:
    c, s = np.cos(2 * angle), np.sin(2 * angle)
    return np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1]])


@pytest.mark.long
def test_a_material_file_is_rendered_back(tmp_path, configs):
    path = tmp_path / "m.yaml"
    path.write_text("kind: rough_plastic\nname: tile\nconstants: {662: {n: 1.5, alpha: 0.3, albedo: 0.25}}\n")
    model = load_reflectance(path)
    table = model_table(model, 662)
    assert table.units == "1/sr"
    some = np.random.default_rng(0).integers(0, table.bins.size, 100)
    some = some[table.axes.angles(table.bins[some]).theta_d > 0]
    points = ScatteringGeometry(*directions(*table.axes.angles(table.bins[some])), up=np.array([0.0, 0, 1]))
    np.testing.assert_allclose(table.mean[:, some].T, model.brdf(points, 662).reshape(-1, 16), rtol=1e-9, atol=1e-12)
    with pytest.raises(TableError, match="only a dominant process"):
        model_table(load_reflectance(configs / "materials/red_print.yaml"), 662)


def test_a_kind_that_is_not_fitted_is_refused(tmp_path):
    with pytest.raises(ProcessError, match="rough_plastic"):
        fit_products([tmp_path / "a.h5"], tmp_path / "g.yaml", kind="first_surface")
