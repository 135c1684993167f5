"""The simulated surface is traced with fields in space, the model is the paper's formulas: they have to agree."""

from pathlib import Path

import numpy as np
import pytest

from processing.geometry.frames import ScatteringGeometry, unit
from processing.reflectance import first_surface
from simulators.bench.scene import Scene
from simulators.bench.traced_surface import TracedSurface, trace_surface


@pytest.mark.parametrize("wavelength_nm", [451.0, 662.0])
@pytest.mark.parametrize("omega_deg", [0.0, 35.0, 120.0])
def test_the_paper_s_model_is_what_the_fields_do(configs: Path, omega_deg, wavelength_nm):
    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    points = scene.object.geometry.at(omega_deg, 61, 61).points
    matrices = trace_surface(scene.material).mueller_jones(points, wavelength_nm)
    assert np.abs(matrices - scene.material.mueller_jones(points, wavelength_nm)).max() < 1e-12
    jones = trace_surface(scene.material).jones(points, wavelength_nm)
    assert np.abs(jones - scene.material.jones(points, wavelength_nm)).max() < 1e-12


def test_a_good_conductor_is_a_mirror():
    metal = TracedSurface(first_surface.Model(name="metal", constants={500: first_surface.Constants(n=1e-6, k=1e6)}))
    g = ScatteringGeometry(unit([[0, 0, 1]]), unit([[0.2, 0, 1]]), unit([[-0.2, 0, 1]]))
    assert metal.mueller_jones(g, 500)[0] == pytest.approx(np.diag([1.0, 1, -1, -1]), abs=1e-5)


def test_light_that_comes_back_along_its_way_has_no_plane_of_incidence():
    glass = TracedSurface(first_surface.Model(name="glass", constants={500: first_surface.Constants(n=1.5)}))
    towards = unit([[0.3, 0.1, 1]])
    m = glass.mueller_jones(ScatteringGeometry(unit([[0, 0, 1]]), towards, towards), 500)[0]
    assert m == pytest.approx(np.diag([1.0, 1, -1, -1]), abs=1e-12)
