"""Sphere found in an image, mesh ray casting and pose, camera calibration."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from processing.geometry.camera_pose import Board, calibrate
from processing.geometry.errors import GeometryError, OutlineNotFound
from processing.geometry.mesh import Mesh
from processing.geometry.outline import find_sphere, register_sphere
from processing.geometry.pinhole import PinholeCamera
from processing.geometry.pose import refine_pose
from processing.geometry.sphere import Sphere
from processing.geometry.viewing import ViewingGeometry
from simulators.bench.scene import Scene
from tests.commands import exit_code

CAMERA = PinholeCamera(rows=200, columns=220, pixel_mm=0.0353, focal_length_mm=60, distance_mm=262.7)


@pytest.fixture(scope="module")
def bumpy(tmp_path_factory) -> str:
    """A closed, asymmetric body of about the size of the sphere."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    x, y, z = ball.vertices.T
    bumps = 1 + 0.12 * np.sin(3 * x + 1) * np.cos(2 * y) + 0.10 * x * y + 0.08 * np.sin(4 * y + 2 * z)
    ball.vertices = ball.vertices * (12.0 * bumps)[:, None] * np.array([1.0, 0.85, 0.9])
    path = tmp_path_factory.mktemp("mesh") / "bumpy.stl"
    ball.export(path)
    return str(path)


def photograph(configs: Path, omega_deg: float, shift: tuple[float, float], zoom: float, seed: int) -> tuple:
    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    camera = scene.spec.geometry.camera.resized(300, 320)
    camera = camera.model_copy(update={"centre_px": (149.5 + shift[0], 159.5 + shift[1]), "focal_length_mm": 60 * zoom})
    view = scene.spec.geometry.model_copy(update={"camera": camera})
    moved = Scene(scene.spec.model_copy(update={"geometry": view}), scene.material)
    light = 4000 * moved.mueller_image(omega_deg, 662, 300, 320)[..., 0, 0]
    rng = np.random.default_rng(seed)
    return rng.poisson(light) + rng.normal(0, 5, light.shape), camera, scene.spec.geometry


@pytest.mark.parametrize("omega_deg", [20.0, 35.0, 60.0, 90.0])
def test_sphere_is_found_within_its_standard_errors(configs, omega_deg):
    image, camera, stated = photograph(configs, omega_deg, (7.3, -11.2), 0.97, seed=int(omega_deg))
    circle = find_sphere(image)
    radius = camera.focal_px * 12.7 / np.sqrt(262.7**2 - 12.7**2)
    assert abs(circle.row - camera.axis_px[0]) < 3 * circle.row_stderr
    assert abs(circle.column - camera.axis_px[1]) < 3 * circle.column_stderr
    assert abs(circle.radius - radius) < 3 * circle.radius_stderr
    assert circle.radius_stderr < 0.01 * radius
    view = register_sphere(stated, circle, 300, 320)
    assert view.camera.focal_length_mm == pytest.approx(60 * 0.97, rel=0.006)
    assert view.camera.axis_px == pytest.approx(camera.axis_px, abs=1.2)


def test_no_sphere_is_said_and_not_invented(configs):
    with pytest.raises(OutlineNotFound, match="dark"):
        find_sphere(np.zeros((60, 60)))
    cut, _, _ = photograph(configs, 35, (0, 150), 1.0, seed=1)
    with pytest.raises(OutlineNotFound, match="frame"):
        find_sphere(cut)
    noise = np.random.default_rng(0).normal(100, 10, size=(200, 200))
    with pytest.raises(OutlineNotFound):
        find_sphere(noise)
    square = np.zeros((200, 200))
    square[50:150, 60:140] = 100.0
    with pytest.raises(OutlineNotFound):
        find_sphere(square)
    with pytest.raises(OutlineNotFound):
        find_sphere(np.full((100, 100), np.nan))


def test_mesh_of_a_sphere_equals_the_sphere(tmp_path):
    import trimesh

    trimesh.creation.icosphere(subdivisions=5, radius=12.7).export(tmp_path / "ball.ply")
    mesh = ViewingGeometry(camera=CAMERA, source_distance_mm=672.7, shape=Mesh(file=str(tmp_path / "ball.ply")))
    ball = mesh.model_copy(update={"shape": Sphere(radius_mm=12.7)})
    a, b = mesh.at(40), ball.at(40)
    overlap = a.mask & b.mask
    assert (a.mask ^ b.mask).mean() < 0.01
    difference = a.fill(a.points.normal)[overlap] - b.fill(b.points.normal)[overlap]
    assert np.percentile(np.linalg.norm(difference, axis=1), 99) < 0.02


def test_mesh_shades_itself(tmp_path):
    import trimesh

    wall = trimesh.creation.box((2, 20, 20))
    wall.apply_translation([6, 0, 10])
    floor = trimesh.creation.box((30, 20, 2))
    trimesh.util.concatenate([wall, floor]).export(tmp_path / "corner.obj")
    view = ViewingGeometry(camera=CAMERA, source_distance_mm=672.7, shape=Mesh(file=str(tmp_path / "corner.obj")))
    row = view.at(50).mask[100]
    # The source stands on the right, behind the wall: the floor left of it lies in its shadow for about 20 tan(50).
    x = (np.arange(220) - 109.5) / CAMERA.focal_px * 262
    assert not row[(x > -10) & (x < 4)].any()
    assert view.at(0).mask[100][(x > -10) & (x < 4)].all()


def test_pose_is_refined_to_the_outline(bumpy):
    true = Mesh(file=bumpy, rotation_deg=(4, -6, 5), translation_mm=(0.6, -0.4, 1.5))
    silhouette = true.intersect(CAMERA.position_mm, CAMERA.rays(), 0.0)[0]
    fit = refine_pose(Mesh(file=bumpy), CAMERA, silhouette)
    off = np.array([*fit.mesh.rotation_deg, *fit.mesh.translation_mm]) - [4, -6, 5, 0.6, -0.4, 1.5]
    assert fit.residual_px < 0.4
    assert np.all(np.abs(off) < 3 * fit.stderr)
    assert np.abs(off[:3]).max() < 0.8
    assert np.abs(off[3:5]).max() < 0.02


def test_the_turn_of_a_ball_cannot_be_seen_in_its_outline(tmp_path):
    import trimesh

    trimesh.creation.icosphere(subdivisions=4, radius=12.0).export(tmp_path / "ball.stl")
    true = Mesh(file=str(tmp_path / "ball.stl"), translation_mm=(0.5, 0.3, 0.0))
    silhouette = true.intersect(CAMERA.position_mm, CAMERA.rays(), 0.0)[0]
    fit = refine_pose(Mesh(file=true.file), CAMERA, silhouette)
    assert fit.identifiable == 3
    assert fit.mesh.translation_mm[:2] == pytest.approx((0.5, 0.3), abs=0.02)


def test_bad_meshes_and_silhouettes_are_refused(bumpy, tmp_path):
    import trimesh

    rays = CAMERA.rays()
    with pytest.raises(GeometryError, match="no such mesh"):
        Mesh(file=str(tmp_path / "none.stl")).intersect(CAMERA.position_mm, rays, 0.0)
    (tmp_path / "text.ply").write_text("no mesh")
    with pytest.raises(GeometryError, match="cannot be read"):
        Mesh(file=str(tmp_path / "text.ply")).intersect(CAMERA.position_mm, rays, 0.0)
    (tmp_path / "flat.obj").write_text("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n")
    with pytest.raises(GeometryError, match="three finite numbers"):
        Mesh(file=str(tmp_path / "flat.obj")).intersect(CAMERA.position_mm, rays, 0.0)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=10)
    ball.update_faces(np.arange(len(ball.faces)) > 5)
    ball.export(tmp_path / "open.stl")
    with pytest.raises(GeometryError, match="has holes"):
        Mesh(file=str(tmp_path / "open.stl")).intersect(CAMERA.position_mm, rays, 0.0)
    hit = Mesh(file=str(tmp_path / "open.stl"), allow_holes=True).intersect(CAMERA.position_mm, rays, 0.0)[0]
    assert hit.any()
    with pytest.raises(OutlineNotFound, match="empty"):
        refine_pose(Mesh(file=bumpy), CAMERA, np.zeros((200, 220), dtype=bool))
    edge = np.zeros((200, 220), dtype=bool)
    edge[:50] = True
    with pytest.raises(OutlineNotFound, match="border"):
        refine_pose(Mesh(file=bumpy), CAMERA, edge)


BOARD = Board(columns=8, rows=6, square_mm=5.0, marker_mm=3.6)


def board_views(count: int) -> tuple[list, np.ndarray, list[float]]:
    """Images of the board by a camera of known matrix, through the homography of each pose."""
    matrix = np.array([[2000.0, 0, 330], [0, 2000.0, 235], [0, 0, 1]])
    scale = 20  # pixels per mm of the printed board
    print_ = BOARD.opencv().generateImage((8 * 5 * scale, 6 * 5 * scale))
    rng = np.random.default_rng(2)
    images, distances = [], []
    for k in range(count):
        turn = np.zeros(3) if k == 0 else rng.uniform(-0.5, 0.5, 3)
        distance = 250.0 if k == 0 else rng.uniform(230, 280)
        r = cv2.Rodrigues(turn)[0]
        centre = np.array([20.0, 15.0, 0.0])
        t = np.array([0, 0, distance]) - r @ centre
        plane = matrix @ np.column_stack([r[:, 0], r[:, 1], t])
        # Pixel centres of the print: x mm = (u + 0.5) / scale.
        to_mm = np.array([[1 / scale, 0, 0.5 / scale], [0, 1 / scale, 0.5 / scale], [0, 0, 1]])
        image = cv2.warpPerspective(print_, plane @ to_mm, (640, 480), flags=cv2.INTER_AREA, borderValue=255)
        images.append((f"view{k}", image))
        distances.append(distance)
    return images, matrix, distances


def test_camera_is_calibrated_from_a_charuco_board():
    images, matrix, _ = board_views(10)
    result = calibrate(images, BOARD, pixel_mm=0.01)
    assert len(result.used) >= 8
    assert result.residual_px < 0.5
    assert result.camera.focal_length_mm == pytest.approx(20.0, rel=0.01)
    # A long lens fixes its axis badly, and says so.
    for k, name in enumerate(("centre_row_px", "centre_column_px")):
        assert abs(result.camera.axis_px[k] - matrix[1 - k, 2]) < 4 * result.camera.stderr[name]
    assert result.camera.distance_mm == pytest.approx(250, rel=0.015)


def test_too_few_boards_are_said():
    images, _, _ = board_views(3)
    with pytest.raises(OutlineNotFound, match="4 are needed"):
        calibrate(images, BOARD, pixel_mm=0.01)
    with pytest.raises(GeometryError, match="do not fit"):
        calibrate(images, Board(8, 6, 3.0, 5.0), pixel_mm=0.01)


def test_camera_pose_command_writes_a_camera_file(tmp_path, capsys):
    from processing.commands.application import main
    from processing.yaml_file import load_yaml

    images, _, _ = board_views(7)
    files = []
    for name, image in images:
        files.append(str(tmp_path / f"{name}.png"))
        cv2.imwrite(files[-1], image)
    board = ["--squares", "8x6", "--square-mm", "5", "--marker-mm", "3.6", "--pixel-mm", "0.01"]
    out = tmp_path / "camera.yaml"
    assert exit_code(main, "camera-pose", *files, *board, "--out", out) == 0
    assert "reprojection error" in capsys.readouterr().out
    assert load_yaml(out, PinholeCamera).focal_length_mm == pytest.approx(20, rel=0.02)
    assert exit_code(main, "camera-pose", *files, "--squares", "eight", *board[2:], "--out", out) == 2
    assert "8x6" in capsys.readouterr().err


def test_a_ray_that_meets_no_normal_meets_nothing(tmp_path):
    import trimesh

    box = trimesh.creation.box((10, 10, 10))
    # Corners as far away as a flipped bit of a number puts them.
    box.vertices[1] = (-5, -5, 1e10)
    box.vertices[2] = (1e10, 3.4588234, -5)
    box.export(tmp_path / "far.ply")
    rays = np.tile((0.0, 0.0, -1.0), (4, 1))
    hit, points, normals = Mesh(file=str(tmp_path / "far.ply")).intersect(np.array([0.0, 0.0, 100.0]), rays, 0.0)
    assert len(points) == len(normals) == hit.sum()
    assert np.isfinite(points).all()
    assert np.isfinite(normals).all()
