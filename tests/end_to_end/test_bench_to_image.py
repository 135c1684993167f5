"""The whole path: `acquire` on the simulated rig, `process`, and the scene's truth within the stated errors."""

import re
from pathlib import Path

import numpy as np
import pytest

from processing.commands.application import main
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.maps.xi0 import xi0_of_stokes
from processing.reduction.stokes import reduce_stokes
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Product, Step
from simulators.bench.scene import Scene
from tests.commands import exit_code


def taken(out: str) -> Path:
    match = re.search(r"^capture\s+(\S+)$", out, re.MULTILINE)
    assert match is not None, out
    return Path(match[1])


def process(*args: object) -> None:
    assert exit_code(main, *args) == 0


def scaled(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Truth in counts: the source's strength is not part of the scene."""
    return truth * (np.sum(image * truth) / np.sum(truth**2))


@pytest.mark.long
def test_mueller_image_and_xi0_agree_with_the_scene(acquire, small_rig, configs: Path, tmp_path: Path) -> None:
    out = acquire.made("--omega", 35, "--rig", small_rig(), "--out", tmp_path)
    capture = taken(out)
    process("reduce", capture, "--no-figure")
    image = MuellerImage.load(capture.with_suffix(".mueller.h5"))
    assert image.simulated
    rows, columns = image.mask.shape
    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    truth = scene.truth(35, 662, rows, columns)
    expected = scene.mueller_image(35, 662, rows, columns)[truth.mask].astype(float)
    matrices = image.matrices[truth.mask]
    errors = np.moveaxis(image.errors, (0, 1), (-2, -1))[truth.mask]
    pulls = (matrices - scaled(matrices, expected)) / errors
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=0.03)
    process("xi0", capture, "--no-figure")
    with Product(capture.with_suffix(".xi0.h5")) as product:
        good = (product.get("valid") > 0) & truth.mask
        assert good.sum() > 0.8 * truth.mask.sum()
        assert np.all(product.get("valid")[~truth.mask] == 0)
        # Where xi0 hardly stands out it is not normally distributed: the intervals are what must hold.
        for name, level, room in (("xi0_68", 0.683, 0.04), ("xi0_95", 0.95, 0.025)):
            low, high = product.get(name)[:, good]
            assert np.mean((low <= truth.xi0[good]) & (truth.xi0[good] <= high)) == pytest.approx(level, abs=room), name


@pytest.mark.long
def test_xi0_from_a_stokes_capture_agrees_with_the_scene(acquire, small_rig, configs: Path, tmp_path: Path) -> None:
    code, out, err = acquire(
        "--mode", "stokes", "--omega", 35, "--rig", small_rig(rows=256, columns=320), "--out", tmp_path
    )
    assert code == 0, err
    capture = taken(out)
    geometry, material = configs / "geometries/one_inch_sphere.yaml", configs / "materials/red_print.yaml"
    process("xi0", capture, "--geometry", geometry, "--material", material)
    with Product(capture.with_suffix(".xi0.h5")) as product:
        truth = Scene.load(configs / "scenes/red_sphere.yaml").truth(35, 662, *product.shape)
        good = product.get("valid") > 0
        assert good.sum() > 0.8 * truth.mask.sum()
        for name, expected in (("xi0", truth.xi0[good]), ("m00", scaled(product.get("m00")[good], truth.m00[good]))):
            pulls = (product.get(name)[good] - expected) / product.get(f"{name}_errors")[good]
            assert np.mean(pulls**2) == pytest.approx(1.0, abs=0.08), name


def test_stokes_capture_without_arm_angle(configs: Path, synthetic_capture, tmp_path: Path) -> None:
    instrument = configs / "instruments/linear_stokes.yaml"
    path = synthetic_capture(
        np.full((1, 1, 16, 16), 500, np.uint16),
        {},
        mosaic=InstrumentModel.load(instrument).mosaic,
        instrument_yaml=instrument.read_text(encoding="utf-8"),
    )
    geometry, material = configs / "geometries/one_inch_sphere.yaml", configs / "materials/red_print.yaml"
    with Capture(path) as capture:
        reduce_stokes(capture, capture.instrument, tmp_path / "s.h5", (Step("reduce", {}),))
    with pytest.raises(ProcessError, match="does not say its arm angle"):
        xi0_of_stokes(tmp_path / "s.h5", geometry, material, tmp_path / "x.h5", step=Step("xi0", {}), overwrite=False)


@pytest.mark.long
@pytest.mark.parametrize(
    ("sample", "omega", "expected"), [("air", 180, np.eye(4)), ("mirror", 10, np.diag([1.0, 1.0, -1.0, -1.0]))]
)
def test_known_samples(sample: str, omega: int, expected: np.ndarray, acquire, small_rig, tmp_path: Path) -> None:
    out = acquire.made("--sample", sample, "--omega", omega, "--rig", small_rig(), "--out", tmp_path)
    capture = taken(out)
    process("reduce", capture, "--no-figure")
    image = MuellerImage.load(capture.with_suffix(".mueller.h5"))
    good = image.mask == 0
    matrices, errors = image.matrices[good], np.moveaxis(image.errors, (0, 1), (-2, -1))[good]
    pulls = (matrices - scaled(matrices, np.broadcast_to(expected, matrices.shape))) / errors
    assert np.mean(pulls**2) == pytest.approx(1.0, abs=0.03)
    mean = matrices.mean(axis=0) / matrices[:, 0, 0].mean()
    assert np.max(np.abs(mean - expected)) < 0.003
