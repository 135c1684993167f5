"""Reflectance models: Fresnel, first surface, polarized diffuse."""

from pathlib import Path

import numpy as np
import pytest

from processing.geometry.frames import ScatteringGeometry, unit
from processing.polarization import mueller
from processing.reflectance import fresnel, polarized_diffuse
from processing.reflectance.base import kinds, load_reflectance, normalized_mueller
from processing.reflectance.changes import ReflectanceChanges
from processing.reflectance.effects.base import reflectance_effects
from processing.yaml_file import ConfigError
from simulators.conformance import ReflectanceConformance
from simulators.conformance.reflectance import random_geometry

CONSTANTS = {"n": 1.3, "k": 0.08, "a": 0.17, "b": 2.0}


def model(kind: str):
    constants = CONSTANTS if kind == "polarized_diffuse" else {k: CONSTANTS[k] for k in ("n", "k")}
    return kinds()[kind].model_validate({"kind": kind, "name": "test", "constants": {662: constants}})


def flat_reflection(theta: float) -> ScatteringGeometry:
    """In-plane specular reflection off a vertical surface, source to the right."""
    wi, wo = [np.sin(theta), 0, np.cos(theta)], [-np.sin(theta), 0, np.cos(theta)]
    return ScatteringGeometry(*(np.array([v]) for v in ([0.0, 0, 1], wi, wo)))


def test_fresnel_energies_equal_the_textbook_tangent_and_sine_forms():
    t = np.deg2rad([10.0, 30.0, 56.0, 80.0])
    rs, rp = fresnel.amplitudes(1.5, t)
    u = np.arcsin(np.sin(t) / 1.5)
    np.testing.assert_allclose(rs.real, -np.sin(t - u) / np.sin(t + u), rtol=1e-12)
    np.testing.assert_allclose(rp.real, np.tan(t - u) / np.tan(t + u), rtol=1e-12)


def test_fresnel_at_normal_incidence_and_at_brewster():
    rs, rp = fresnel.amplitudes(1.2 + 0.25j, 0.0)
    assert rp == pytest.approx(-rs)
    assert abs(rs) ** 2 == pytest.approx(abs((0.2 + 0.25j) / (2.2 + 0.25j)) ** 2)
    assert abs(fresnel.amplitudes(1.5, np.arctan(1.5))[1]) < 1e-15


def test_absorbing_metal_delays_as_decreasing_phase_asks():
    # Gold-like index: between normal and grazing incidence r_p / -r_s runs from phase 0 to 180 degrees.
    rs, rp = fresnel.amplitudes(0.2 + 3.3j, np.deg2rad([0.01, 70.0, 89.9]))
    phase = np.angle(-rp / rs)
    assert abs(phase[0]) < 1e-3
    assert 0 < abs(phase[1]) < np.pi
    assert abs(abs(phase[2]) - np.pi) < 0.1
    assert np.all(np.abs(rs) <= 1)
    assert np.all(np.abs(rp) <= 1)


def test_perfect_conductor_is_the_ideal_mirror_in_the_instrument_frames():
    m = normalized_mueller(fresnel.jones(flat_reflection(1e-3), 1e-6 + 1e6j))[0]
    np.testing.assert_allclose(m, mueller.IDEAL_MIRROR, atol=1e-5)


def test_first_surface_polarizes_vertically_and_fully_at_brewster():
    m = normalized_mueller(fresnel.jones(flat_reflection(np.arctan(1.5)), 1.5))[0]
    assert m[1, 0] == pytest.approx(-1)
    assert m[0, 1] == pytest.approx(-1)


class TestFirstSurface(ReflectanceConformance):
    material = "{kind: first_surface, name: test, constants: {662: {n: 1.3, k: 0.08}}}"


class TestPolarizedDiffuse(ReflectanceConformance):
    material = "{kind: polarized_diffuse, name: test, constants: {662: {n: 1.3, k: 0.08, a: 0.17, b: 2.0}}}"


class TestRoughPlastic(ReflectanceConformance):
    material = "{kind: rough_plastic, name: test, constants: {662: {n: 1.5, alpha: 0.3, albedo: 0.2}}}"


def test_every_model_passes_the_conformance_kit():
    materials = (TestFirstSurface.material, TestPolarizedDiffuse.material, TestRoughPlastic.material)
    assert {material.split(",")[0].removeprefix("{kind: ") for material in materials} == set(kinds())


def test_first_surface_does_not_know_the_normal():
    g = random_geometry(300)
    rotated = ScatteringGeometry(np.roll(g.normal, 1, axis=0), g.to_source, g.to_camera)
    np.testing.assert_array_equal(model("first_surface").jones(g, 662), model("first_surface").jones(rotated, 662))


def test_diffuse_polarizance_points_away_from_the_specular_point():
    # Source right of the camera; normals tilted from h towards each clock position, small tilt.
    wi = unit([np.sin(0.3), 0, np.cos(0.3)])
    wo = unit([-np.sin(0.3), 0, np.cos(0.3)])
    around = np.deg2rad(np.arange(0, 360, 15.0))
    n = unit(np.stack([0.05 * np.cos(around), 0.05 * np.sin(around), np.ones_like(around)], axis=-1))
    g = ScatteringGeometry(n, np.broadcast_to(wi, n.shape), np.broadcast_to(wo, n.shape))
    m = normalized_mueller(polarized_diffuse.diffuse_jones(g))
    angle = 0.5 * np.arctan2(m[:, 2, 0], m[:, 1, 0])
    miss = (angle - around + np.pi / 2) % np.pi - np.pi / 2
    assert np.rad2deg(np.abs(miss).max()) < 0.5


def test_unknown_kind_key_and_wavelength_are_named(tmp_path: Path, configs: Path):
    bad = tmp_path / "m.yaml"
    bad.write_text("kind: velvet\nname: x\n")
    with pytest.raises(ConfigError, match="velvet"):
        load_reflectance(bad)
    bad.write_text("kind: first_surface\nname: x\nconstants:\n  662: {n: 1.3, kk: 1}\n")
    with pytest.raises(ConfigError, match=r"m.yaml:4: .*kk: unknown key"):
        load_reflectance(bad)
    red = load_reflectance(configs / "materials/red_print.yaml")
    with pytest.raises(ConfigError, match="524"):
        red.mueller_jones(random_geometry(2), 524)


@pytest.mark.parametrize("kind", reflectance_effects())
def test_a_small_effect_changes_little_also_beside_a_diffuse_term(kind):
    effect, g = reflectance_effects()[kind], random_geometry(100)
    for place in effect.places_on("flat"):
        without, bent = (ReflectanceChanges(diffuse_a=0.17) for _ in range(2))
        effect.bend(bent, place, 1e-6 * np.array([p.typical for p in effect.parameters(place)]))
        apart = bent.dominant(g, 1.3 + 0.08j) - without.dominant(g, 1.3 + 0.08j)
        assert np.abs(apart).max() < 1e-4
