"""Frames, cameras, surfaces and Rusinkiewicz angles against definitions written out independently."""

import numpy as np
import pytest

from processing.geometry import rusinkiewicz
from processing.geometry.flat import Flat
from processing.geometry.frames import ScatteringGeometry, change_frames, unit
from processing.geometry.pinhole import PinholeCamera
from processing.geometry.sphere import Sphere
from processing.geometry.viewing import ViewingGeometry
from processing.polarization import mueller

#: The lab's sphere.
LAB = ViewingGeometry(
    camera=PinholeCamera(rows=61, columns=61, pixel_mm=0.116, focal_length_mm=60, distance_mm=262.7),
    source_distance_mm=672.7,
    shape=Sphere(radius_mm=12.7),
)


def random_directions(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    n = unit(rng.normal(size=(count, 3)))

    def over(n: np.ndarray) -> np.ndarray:
        v = unit(rng.normal(size=n.shape))
        return v * np.sign(np.sum(v * n, axis=-1))[:, None]

    return n, over(n), over(n)


def rusinkiewicz_by_rotation(n: np.ndarray, wi: np.ndarray, wo: np.ndarray) -> tuple[float, float, float]:
    """Rusinkiewicz 1998: turn the world until n is +z, then undo phi_h about z and theta_h about y."""
    t = np.cross(n, [0.3, 0.5, 0.8])
    t /= np.linalg.norm(t)
    world = np.stack([t, np.cross(n, t), n])
    wi, wo = world @ wi, world @ wo
    h = (wi + wo) / np.linalg.norm(wi + wo)
    th, ph = np.arccos(h[2]), np.arctan2(h[1], h[0])
    rz = np.array([[np.cos(-ph), -np.sin(-ph), 0], [np.sin(-ph), np.cos(-ph), 0], [0, 0, 1]])
    ry = np.array([[np.cos(-th), 0, np.sin(-th)], [0, 1, 0], [-np.sin(-th), 0, np.cos(-th)]])
    d = ry @ rz @ wi
    return th, np.arccos(d[2]), np.arctan2(d[1], d[0])


def test_rusinkiewicz_angles_equal_the_definition_by_rotations():
    n, wi, wo = random_directions(200)
    angles = np.stack(rusinkiewicz.angles(n, wi, wo), axis=-1)
    reference = np.array([rusinkiewicz_by_rotation(*row) for row in zip(n, wi, wo, strict=True)])
    np.testing.assert_allclose(angles, reference, atol=1e-7)


def test_directions_is_the_inverse_of_angles():
    rng = np.random.default_rng(1)
    truth = rng.uniform([0.01, 0.01, -3.1], [1.2, 1.2, 3.1], size=(100, 3))
    angles = rusinkiewicz.angles(*rusinkiewicz.directions(*truth.T))
    np.testing.assert_allclose(np.stack(angles, axis=-1), truth, atol=1e-12)


def test_angles_are_finite_where_phi_d_is_undefined():
    z = np.array([[0.0, 0.0, 1.0]])
    assert [float(v[0]) for v in rusinkiewicz.angles(z, z, z)] == [0.0, 0.0, 0.0]


def test_instrument_axes_are_right_handed_and_identical_looking_through():
    g = LAB.at(180).points  # nothing of the sphere is lit from behind
    assert g.normal.size == 0
    straight = ScatteringGeometry(*(np.array([v]) for v in ([0.0, 0, 1], [0.0, 0, -1], [0.0, 0, 1])))
    np.testing.assert_allclose(straight.axes_in[0], straight.axes_out[0], atol=1e-15)
    n, wi, wo = random_directions(50)
    g = ScatteringGeometry(n, wi, wo)
    for (x, y), k in ((g.axes_in, -wi), (g.axes_out, wo)):
        np.testing.assert_allclose(np.cross(x, y), k, atol=1e-12)
        assert np.all(y[:, 1] > 0)  # both y point up


def test_change_of_frames_is_undone_by_the_way_back_and_keeps_a_depolarizer():
    n, wi, wo = random_directions(40)
    g = ScatteringGeometry(n, wi, wo)
    m = np.random.default_rng(2).normal(size=(40, 4, 4))
    turned = change_frames(m, g, n)
    back = change_frames(turned, g.with_up(n), [0.0, 1.0, 0.0])
    np.testing.assert_allclose(back, m, atol=1e-12)
    assert np.abs(turned - m).max() > 0.1
    np.testing.assert_allclose(
        change_frames(mueller.IDEAL_DEPOLARIZER, g, n), np.tile(mueller.IDEAL_DEPOLARIZER, (40, 1, 1))
    )


def test_sphere_points_project_back_to_their_pixels_and_lie_on_it():
    image = LAB.at(35)
    g = image.points
    camera = LAB.camera
    points = g.normal * 12.7
    where = camera.project(points)
    np.testing.assert_allclose(where, np.argwhere(image.mask), atol=1e-6)
    np.testing.assert_allclose(g.to_camera, unit(camera.position_mm - points), atol=1e-12)


def test_sphere_outline_is_the_tangent_cone():
    image = LAB.at(0)
    radius = 12.7 / np.sqrt(262.7**2 - 12.7**2) * LAB.camera.focal_px
    assert image.mask.sum() == pytest.approx(np.pi * radius**2, rel=0.02)


def test_theta_d_of_the_lab_sphere_is_near_half_of_omega():
    # The nearest point stands 250 mm and, at omega 0, 660 mm away.
    for omega in (20.0, 35.0, 90.0):
        td = np.rad2deg(LAB.at(omega).points.angles.theta_d)
        assert abs(np.median(td) - omega / 2) < 1.5


def test_distortion_is_undone_by_the_rays():
    camera = PinholeCamera(
        rows=40,
        columns=50,
        pixel_mm=0.1,
        focal_length_mm=10,
        distance_mm=100,
        distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.0),
    )
    rays = camera.rays()
    points = camera.position_mm + rays * 90
    rows, columns = np.mgrid[:40, :50]
    np.testing.assert_allclose(camera.project(points), np.stack([rows, columns], axis=-1), atol=1e-6)


def test_resized_camera_keeps_the_field_of_view():
    small = LAB.camera.resized(30, 30)
    np.testing.assert_allclose(
        small.rays()[0, 0], LAB.camera.resized(60, 60).rays()[:2, :2].mean(axis=(0, 1)), atol=1e-5
    )


def test_flat_sample_follows_the_arm_into_the_specular_pose():
    view = LAB.model_copy(update={"shape": Flat(width_mm=10, height_mm=10)})
    th = view.at(50).points.angles.theta_h
    assert np.rad2deg(th.min()) < 0.5
    fixed = view.model_copy(update={"shape": Flat(width_mm=10, height_mm=10, normal_deg=0)})
    assert np.rad2deg(np.median(fixed.at(50).points.angles.theta_h)) == pytest.approx(25, abs=1.5)
