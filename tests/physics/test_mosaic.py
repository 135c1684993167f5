"""Demosaicing: exact where it must be, better than its rivals where it claims to be, with honest noise."""

from collections.abc import Callable
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from processing.reduction.mosaic.demosaic import demosaic, demosaicing_methods, method_of
from processing.reduction.mosaic.fused import bilinear_stokes
from processing.reduction.mosaic.layout import MosaicError, MosaicLayout
from processing.reduction.mosaic.merge import MergedFrame
from processing.reduction.mosaic.methods.oriented import directions
from processing.reduction.mosaic.noise import stokes_covariance
from processing.reduction.stokes import DEFAULT_METHOD, stokes

NAMES = ("0", "45", "90", "135")
ANGLES = np.deg2rad([0.0, 45.0, 90.0, 135.0])
FULL = 4095.0
Scene = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
ANALYZERS = np.array([[0.5, 0.5 * np.cos(2 * t), 0.5 * np.sin(2 * t)] for t in np.deg2rad([0.0, 45, 90, 135])])
LAYOUT = MosaicLayout.of((("90", "45"), ("135", "0")), NAMES, ANALYZERS)
METHODS = tuple(demosaicing_methods())
FULL_SIZE = [m for m in METHODS if demosaic(np.ones((24, 28)), LAYOUT, m).shape == (4, 24, 28)]


def mosaic(channels: np.ndarray, layout: MosaicLayout = LAYOUT) -> np.ndarray:
    frame = np.empty(channels.shape[1:])
    for k, (r, c) in enumerate(layout.offsets):
        frame[r::2, c::2] = channels[k, r::2, c::2]
    return frame


def test_methods_that_interpolate_have_the_size_of_the_frame() -> None:
    assert {DEFAULT_METHOD, "bilinear", "guided-residual", "oriented"} <= set(FULL_SIZE)
    assert "superpixel" not in FULL_SIZE


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
def test_even_light_stays_even(method: str, dtype: type) -> None:
    values = np.array([120.0, 80.0, 40.0, 82.0])
    channels = np.broadcast_to(values[:, None, None], (4, 24, 28))
    planes = demosaic(mosaic(channels).astype(dtype), LAYOUT, method)
    assert planes.dtype == np.float32
    assert planes.shape == ((4, 24, 28) if method in FULL_SIZE else (4, 12, 14))
    np.testing.assert_allclose(planes, np.broadcast_to(values[:, None, None], planes.shape), rtol=2e-3)


@pytest.mark.parametrize("method", FULL_SIZE)
def test_gradients_and_the_place_of_the_pixels(method: str) -> None:
    y, x = np.indices((40, 48), dtype=float)
    stokes = np.stack([1000 + 6 * x + 3 * y, 200 + 2 * x, 100 - 1.5 * y])
    truth = np.tensordot(ANALYZERS, stokes, axes=1)
    planes = demosaic(mosaic(truth), LAYOUT, method)
    inner = np.s_[:, 8:-8, 8:-8]
    # Half a pixel of shift would be an error of 2 counts or more in every channel.
    assert np.max(np.abs(planes[inner] - truth[inner])) < 0.7


@pytest.mark.parametrize("method", METHODS)
def test_any_arrangement_of_the_super_pixel(method: str) -> None:
    rng = np.random.default_rng(1)
    stokes = np.stack([1000 + 50 * rng.normal(size=(32, 32)), np.full((32, 32), 300.0), np.full((32, 32), -200.0)])
    truth = np.tensordot(ANALYZERS, stokes, axes=1)
    layout = MosaicLayout.of((("0", "135"), ("45", "90")), NAMES, ANALYZERS)
    turned = demosaic(mosaic(truth, layout), layout, method)
    # The same scene turned by 180 degrees has the first arrangement.
    straight = demosaic(mosaic(truth, layout)[::-1, ::-1].copy(), LAYOUT, method)[:, ::-1, ::-1]
    inner = np.s_[:, 5:-5, 5:-5]
    np.testing.assert_allclose(turned[inner], straight[inner], atol=0.2)


@pytest.mark.parametrize("method", METHODS)
def test_noise_of_stokes_is_what_the_covariance_says(method: str) -> None:
    rng = np.random.default_rng(2)
    values = np.array([1400.0, 1000.0, 500.0, 900.0])
    variance = values / 3.0 + 2.0
    channels = np.broadcast_to(values[:, None, None], (4, 200, 200))
    sigma = np.sqrt(np.broadcast_to(variance[:, None, None], channels.shape))
    solve = np.linalg.pinv(ANALYZERS)
    vectors = np.stack(
        [
            np.tensordot(
                solve, demosaic(mosaic(channels + sigma * rng.normal(size=sigma.shape)), LAYOUT, method), axes=1
            )
            for _ in range(4)
        ]
    )
    shape = vectors.shape[2:]
    covariance = stokes_covariance(
        np.broadcast_to(variance[:, None, None], (4, *shape)).astype(np.float32), LAYOUT, method, solve
    )
    truth = solve @ values
    inner = np.s_[..., 10:-10, 10:-10]
    deviation = (vectors - truth[None, :, None, None])[inner]
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    for k, (a, b) in enumerate(pairs):
        measured = np.mean(deviation[:, a] * deviation[:, b])
        scale = np.sqrt(np.mean(covariance[a][inner]) * np.mean(covariance[b][inner]))
        assert measured / scale == pytest.approx(np.mean(covariance[k][inner]) / scale, abs=0.06), (a, b)


@pytest.mark.parametrize("electrons", [20.0, 200.0, 20_000.0])
@pytest.mark.parametrize("polarized", [0.0, 0.02, 0.2, 0.4])
def test_every_pixel_has_an_interval_of_its_degree_and_angle_of_polarization(
    polarized: float, electrons: float
) -> None:
    random, size = np.random.default_rng(6), (160, 160)
    light = electrons * np.array([2.0, 2 * polarized * 0.6, -2 * polarized * 0.8])
    expected = mosaic(np.broadcast_to((ANALYZERS @ light)[:, None, None], (4, *size)))
    frame = (random.poisson(expected) + random.normal(0, 2.3, size)).astype(np.float32)
    unit = np.ones((1, 1), np.float32)
    merged = MergedFrame(frame, np.zeros(size, np.uint8), unit, unit * np.float32(2.3**2))
    channels = demosaic(frame, LAYOUT, DEFAULT_METHOD)
    maps = stokes(channels, ANALYZERS, LAYOUT, DEFAULT_METHOD, merged=merged, frame=frame)
    turn = (maps["aolp_deg"] - np.rad2deg(np.arctan2(-0.8, 0.6)) / 2 + 90) % 180 - 90
    for name, error in {"dolp": maps["dolp"] - polarized, "aolp_deg": turn}.items():
        if name == "aolp_deg" and not polarized:
            continue
        low, high = maps[f"{name}_95"] - maps[name]
        assert 0.62 < np.mean(np.abs(error) <= maps[f"{name}_errors"]) < 0.76, name
        assert 0.9 < np.mean((low <= -error) & (-error <= high)) < 0.98, name


@pytest.mark.parametrize("method", [name for name, m in demosaicing_methods().items() if not m.linear])
def test_noise_of_an_adaptive_method_is_that_of_its_weights_there(method: str) -> None:
    y, x = np.indices((160, 160), dtype=float)
    level = 2000 + 1500 * np.tanh(np.sin((x + 0.4 * y) / 12) * 2)
    stokes = np.stack([level, 0.2 * level, -0.1 * level])
    frame = mosaic(np.tensordot(ANALYZERS, stokes, axes=1))
    used = directions(frame.astype(np.float32), LAYOUT)
    assert (used > 0).mean() > 0.3
    rng = np.random.default_rng(5)
    solve, sigma = np.linalg.pinv(ANALYZERS), 3.0
    runs = [
        np.tensordot(solve, demosaic(frame + sigma * rng.normal(size=frame.shape), LAYOUT, method), axes=1)
        for _ in range(30)
    ]
    variance = np.full((4, *frame.shape), sigma**2, np.float32)
    covariance = stokes_covariance(variance, LAYOUT, method, solve, frame=frame.astype(np.float32))
    inner = np.s_[..., 10:-10, 10:-10]
    for k in range(3):
        scatter = np.var(np.stack([r[k] for r in runs]), axis=0, ddof=1)
        for chosen in (used > 0, used == 0):
            ratio = np.median((scatter / covariance[k])[inner][chosen[inner]])
            # The median of a variance from 30 runs is 0.977 of its mean.
            assert ratio == pytest.approx(0.977, abs=0.05)


@pytest.mark.parametrize("method", [name for name, m in demosaicing_methods().items() if m.linear])
def test_a_method_that_says_so_is_linear(method: str) -> None:
    first, second = np.random.default_rng(4).uniform(0, 1000, (2, 24, 28))
    parts = demosaic(first, LAYOUT, method) + demosaic(second, LAYOUT, method)
    np.testing.assert_allclose(demosaic(first + second, LAYOUT, method), parts, atol=0.01)


def test_a_method_of_another_package_is_found_and_has_its_own_noise(monkeypatch) -> None:
    """The larger of two neighbours: on a slope the weights are those of one of them."""

    def larger(frame, layout):
        even = demosaic(frame, layout, "bilinear")
        return np.maximum(even, np.roll(even, 1, axis=2))

    plug_in = SimpleNamespace(__doc__="Larger of two.", __name__="plug_in", REACH=2, channels=larger)
    entry = SimpleNamespace(name="larger", value="plug_in", load=lambda: plug_in)
    demosaicing_methods.cache_clear()
    with monkeypatch.context() as patched:
        patched.setattr("processing.reduction.mosaic.demosaic.entry_points", lambda group: [entry])
        x = np.indices((24, 24), dtype=float)[1]
        frame = (100 + 50 * x).astype(np.float32)
        variance = np.full((4, 24, 24), 9.0, np.float32)
        solve = np.linalg.pinv(ANALYZERS)
        covariance = stokes_covariance(variance, LAYOUT, "larger", solve, frame=frame)[:, 4:-4, 4:-4]
        bilinear = stokes_covariance(variance, LAYOUT, "bilinear", solve)[:, 4:-4, 4:-4]
    demosaicing_methods.cache_clear()
    np.testing.assert_allclose(covariance, bilinear, rtol=1e-3, atol=1e-6)


def fractal(rng: np.random.Generator, size: int) -> Scene:
    """1/f^1.6 amplitude spectra: intensity, degree and angle vary together at all scales, no sharp edges."""

    def noise(power: float) -> NDArray[np.float64]:
        f = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
        f[0, 0] = 1
        field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) / f**power).real
        return (field - field.min()) / np.ptp(field)

    return 0.1 + 0.8 * noise(1.6), 0.05 + 0.6 * noise(1.9), np.pi * noise(1.9)


def patches(rng: np.random.Generator, size: int) -> Scene:
    """Overlapping discs and polygons, each with its own intensity, degree and angle, seen through a little blur."""
    s0, dolp, aolp = (np.full((size, size), v) for v in (0.4, 0.2, 0.5))
    for _ in range(90):
        stencil = np.zeros((size, size), np.uint8)
        if rng.random() < 0.5:
            centre = tuple(int(v) for v in rng.integers(0, size, 2))
            cv2.circle(stencil, centre, int(rng.integers(size // 40, size // 8)), 1, -1)
        else:
            points = rng.integers(0, size, 2) + rng.integers(-size // 8, size // 8, (4, 2))
            cv2.fillConvexPoly(stencil, cv2.convexHull(points.astype(np.int32)), 1)
        for image, value in ((s0, rng.uniform(0.1, 0.9)), (dolp, rng.uniform(0, 0.7)), (aolp, rng.uniform(0, np.pi))):
            image[stencil > 0] = value
    return s0, dolp, aolp


def star(rng: np.random.Generator, size: int) -> Scene:
    """Siemens star: spokes in intensity and in degree, the angle running around, up to the highest frequencies."""
    y, x = np.indices((size, size)) - (size - 1) / 2
    turn = np.arctan2(y, x)
    shift = rng.uniform(0, np.pi)
    return (
        0.5 + 0.35 * np.sign(np.cos(36 * turn)),
        0.35 + 0.25 * np.sign(np.cos(18 * turn)),
        np.mod(turn + shift, np.pi),
    )


SCENES: dict[str, Callable[[np.random.Generator, int], Scene]] = {"fractal": fractal, "patches": patches, "star": star}


def channels(scene: Scene) -> NDArray[np.float64]:
    """Intensities (4, rows, columns) in counts behind the four analyzers, blurred by the lens (0.6 pixels)."""
    s0, dolp, aolp = scene
    full = np.stack([0.5 * s0 * (1 + dolp * np.cos(2 * (aolp - t))) for t in ANGLES]) * FULL
    return np.stack([cv2.GaussianBlur(c, (0, 0), 0.6) for c in full])


def psnr(size: int, seed: int, noise: float) -> dict[tuple[str, str], float]:
    """Of all methods on all scenes, dB, inside a border of 16 pixels; `noise` is a part of full scale."""
    out = {}
    for name, make in SCENES.items():
        rng = np.random.default_rng(seed)
        truth = channels(make(rng, size))
        frame = np.empty((size, size))
        for k, (r, c) in enumerate(LAYOUT.offsets):
            frame[r::2, c::2] = truth[k, r::2, c::2]
        frame = np.rint(frame + rng.normal(0, noise * FULL, frame.shape)) if noise else frame
        for method in METHODS:
            planes = demosaic(frame.astype(np.float32), LAYOUT, method).astype(float)
            if planes.shape[1] < size:
                planes = np.repeat(np.repeat(planes, 2, axis=1), 2, axis=2)
            error = np.mean((truth - planes)[..., 16:-16, 16:-16] ** 2)
            out[name, method] = float(10 * np.log10(FULL**2 / max(error, 1e-12)))
    return out


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_default_is_the_best_of_the_table(noise: float) -> None:
    ratios = psnr(size=256, seed=11, noise=noise)
    for scene in SCENES:
        best = max(METHODS, key=lambda m, s=scene: ratios[s, m])
        margin = ratios[scene, best] - ratios[scene, DEFAULT_METHOD]
        assert margin < 0.2, (scene, best)
        assert ratios[scene, DEFAULT_METHOD] > ratios[scene, "difference"] - 0.1
        assert ratios[scene, DEFAULT_METHOD] > ratios[scene, "bilinear"]


def test_reach_is_how_far_a_pixel_is_felt() -> None:
    for method in FULL_SIZE:
        flat = np.full((64, 64), 1000.0)
        poked = flat.copy()
        poked[32, 32] += 5
        moved = np.abs(demosaic(poked, LAYOUT, method) - demosaic(flat, LAYOUT, method)).max(axis=0)
        felt = np.argwhere(moved > 0.005)
        assert np.max(np.abs(felt - 32)) <= method_of(method).reach, method


def test_bad_layouts_and_frames() -> None:
    with pytest.raises(MosaicError, match="2 x 2"):
        MosaicLayout.of((("0", "45", "90"),), NAMES)
    with pytest.raises(MosaicError, match="names each channel once"):
        MosaicLayout.of((("90", "45"), ("135", "135")), NAMES)
    with pytest.raises(MosaicError, match="even number of rows"):
        demosaic(np.zeros((5, 8)), LAYOUT, "bilinear")
    with pytest.raises(MosaicError, match="none of bicubic, bilinear"):
        demosaic(np.zeros((8, 8)), LAYOUT, "magic")
    odd = MosaicLayout.of((("a", "b"), ("c", "d")), ("a", "b", "c", "d"))
    with pytest.raises(MosaicError, match="analyzers at 0, 45, 90 and 135 degrees"):
        demosaic(np.zeros((8, 8)), odd, "oriented")
    assert demosaic(np.zeros((8, 8)), odd, "bilinear").shape == (4, 8, 8)


@pytest.mark.parametrize(
    ("dtype", "arrangement"), [(np.uint16, (("0", "135"), ("45", "90"))), (np.float32, (("90", "45"), ("135", "0")))]
)
def test_one_pass_equals_the_long_way(dtype: type, arrangement: tuple[tuple[str, ...], ...]) -> None:
    layout = MosaicLayout.of(arrangement, NAMES, ANALYZERS)
    rng = np.random.default_rng(3)
    frame = rng.integers(1, 250, (36, 50)).astype(dtype)
    solve = np.linalg.pinv(ANALYZERS)
    vector = bilinear_stokes(frame, layout, solve)
    s = np.tensordot(solve, demosaic(frame, layout, "bilinear").astype(float), axes=1)
    for plane, expected in zip(vector[:3], s, strict=True):
        np.testing.assert_allclose(plane, expected, atol=2e-4)
    np.testing.assert_allclose(vector.dolp, np.hypot(s[1], s[2]) / s[0], atol=1e-5)
    difference = (vector.aolp - 0.5 * np.arctan2(s[2], s[1]) + np.pi / 2) % np.pi - np.pi / 2
    assert np.max(np.abs(difference)) < 2e-6
    assert np.all((vector.aolp >= 0) & (vector.aolp <= np.float32(np.pi)))
