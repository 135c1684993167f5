"""From a simulated scene through noisy captures of both kinds to M and xi0: truth within the stated errors."""

from pathlib import Path

import numpy as np
import pytest

from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.maps.xi0 import xi0_of_mueller, xi0_of_stokes
from processing.reduction.mueller import reduce_mueller
from processing.reduction.stokes import reduce_stokes
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Product, Step
from simulators.bench.scene import Scene

GAIN, READ_NOISE, BLACK, SIZE = 2.6, 2.3, 64.0, 200
OMEGA, WAVELENGTH = 35.0, 662.0
STEP = (Step("reduce", {}),)
ANGLES = {"psg": 9.0 * np.arange(40), "psa": 4.91 * 9.0 * np.arange(40)}
NOISE = {"black_level_counts": BLACK, "gain_e_per_count": GAIN, "read_noise_e": READ_NOISE, "bits": 16}


def counts(rng: np.random.Generator, signal: np.ndarray) -> np.ndarray:
    """Shot noise, read noise, black level and rounding on a signal in counts."""
    electrons = rng.poisson(signal * GAIN) + rng.normal(0, READ_NOISE, signal.shape)
    return np.clip(np.rint(electrons / GAIN + BLACK), 0, 65535).astype(np.uint16)


def drr_capture(scene: Scene, omega: float, level: float, configs: Path, synthetic_capture, size: int = SIZE) -> Path:
    instrument = configs / "instruments/rgb950.yaml"
    m = scene.mueller_image(omega, WAVELENGTH, size, size).reshape(size, size, 16).astype(float)
    w = InstrumentModel.load(instrument).at(WAVELENGTH).rows(ANGLES)
    signal = level * np.einsum("nck,xyk->ncxy", w, m)
    return synthetic_capture(
        counts(np.random.default_rng(7), np.maximum(signal, 0)),
        ANGLES,
        omega_deg=omega,
        detector=NOISE,
        instrument_yaml=instrument.read_text(encoding="utf-8"),
    )


@pytest.fixture
def sphere(configs: Path) -> Scene:
    return Scene.load(configs / "scenes/red_sphere.yaml")


def test_sphere_from_a_mueller_capture(sphere: Scene, configs: Path, synthetic_capture, tmp_path: Path) -> None:
    level = 40000.0
    path = drr_capture(sphere, OMEGA, level, configs, synthetic_capture)
    with Capture(path) as capture:
        reduce_mueller(capture, capture.instrument, tmp_path / "m.h5", STEP)
    image = MuellerImage.load(tmp_path / "m.h5")
    truth = sphere.truth(OMEGA, WAVELENGTH, SIZE, SIZE)
    m = level * sphere.mueller_image(OMEGA, WAVELENGTH, SIZE, SIZE)
    pulls = (image.matrices - m)[truth.mask] / np.moveaxis(image.errors, (0, 1), (-2, -1))[truth.mask]
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=0.03)
    xi0_of_mueller(tmp_path / "m.h5", tmp_path / "x.h5", Step("xi0", {}), False, None)
    with Product(tmp_path / "x.h5") as product:
        assert product.simulated
        assert [s.name for s in product.steps] == ["reduce", "xi0"]
        valid = (product.get("valid") > 0) & truth.mask
        assert valid.sum() > 0.95 * truth.mask.sum()
        pulls = (product.get("xi0") - truth.xi0)[valid] / product.get("xi0_errors")[valid]
        assert np.mean(pulls**2) == pytest.approx(1.0, abs=0.03)
        assert abs(np.mean(pulls)) < 0.05
        assert np.all(product.get("valid")[~truth.mask] == 0)


def test_sphere_from_a_stokes_capture(sphere: Scene, configs: Path, synthetic_capture, tmp_path: Path) -> None:
    # The default method: what others do wrong at the edges of this small image exceeds its noise.
    level, size = 40000.0, 2 * SIZE
    instrument = configs / "instruments/linear_stokes.yaml"
    model = InstrumentModel.load(instrument).at(WAVELENGTH)
    m = sphere.mueller_image(OMEGA, WAVELENGTH, size, size).reshape(size, size, 16).astype(float)
    channels = level * np.einsum("ck,xyk->cxy", model.rows({})[0], m)
    frame = np.empty((size, size))
    for k, channel in enumerate(model.channels):
        row = next(i for i, names in enumerate(model.mosaic or ()) if channel.name in names)
        column = (model.mosaic or ())[row].index(channel.name)
        frame[row::2, column::2] = channels[k, row::2, column::2]
    rng = np.random.default_rng(8)
    frames = np.stack([counts(rng, np.maximum(frame, 0)) for _ in range(4)])[:, None]
    path = synthetic_capture(
        frames,
        {},
        omega_deg=OMEGA,
        detector=NOISE,
        mosaic=model.mosaic,
        instrument_yaml=instrument.read_text(encoding="utf-8"),
    )
    with Capture(path) as capture:
        reduce_stokes(capture, capture.instrument, tmp_path / "s.h5", STEP)
    geometry, material = configs / "geometries/one_inch_sphere.yaml", configs / "materials/red_print.yaml"
    xi0_of_stokes(tmp_path / "s.h5", geometry, material, tmp_path / "x.h5", Step("xi0", {}), False)
    with Product(tmp_path / "x.h5") as product:
        truth = sphere.truth(OMEGA, WAVELENGTH, *product.shape)
        valid = product.get("valid") > 0
        assert valid.sum() > 0.9 * truth.mask.sum()
        for name, expected in (("xi0", truth.xi0), ("m00", level * truth.m00)):
            pulls = (product.get(name) - expected)[valid] / product.get(f"{name}_errors")[valid]
            assert np.mean(pulls**2) == pytest.approx(1.0, abs=0.04), name


@pytest.mark.parametrize(
    ("name", "omega", "expected"),
    [("air", 180.0, np.eye(4)), ("mirror", 5.0, np.diag([1.0, 1.0, -1.0, -1.0]))],
)
def test_air_is_the_identity_and_a_mirror_is_a_mirror(
    name: str, omega: float, expected: np.ndarray, configs: Path, synthetic_capture, tmp_path: Path
) -> None:
    scene, level = Scene.load(configs / f"scenes/{name}.yaml"), 20000.0
    path = drr_capture(scene, omega, level, configs, synthetic_capture, size=40)
    with Capture(path) as capture:
        reduce_mueller(capture, capture.instrument, tmp_path / "m.h5", STEP)
    image = MuellerImage.load(tmp_path / "m.h5")
    throughput = float(np.mean(image.values[0, 0])) / level
    pulls = (image.values - level * throughput * expected[..., None, None]) / image.errors
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=0.03)
    mean = image.values.mean(axis=(2, 3)) / (level * throughput)
    assert np.max(np.abs(mean - expected)) < 0.003


def test_stokes_capture_without_arm_angle(configs: Path, synthetic_capture, tmp_path: Path) -> None:
    instrument = configs / "instruments/linear_stokes.yaml"
    model = InstrumentModel.load(instrument).at(WAVELENGTH)
    path = synthetic_capture(
        np.full((1, 1, 16, 16), 500, np.uint16),
        {},
        mosaic=model.mosaic,
        instrument_yaml=instrument.read_text(encoding="utf-8"),
    )
    with Capture(path) as capture:
        reduce_stokes(capture, model, tmp_path / "s.h5", STEP)
    geometry, material = configs / "geometries/one_inch_sphere.yaml", configs / "materials/red_print.yaml"
    with pytest.raises(ProcessError, match="does not say its arm angle"):
        xi0_of_stokes(tmp_path / "s.h5", geometry, material, tmp_path / "x.h5", Step("xi0", {}), False)
