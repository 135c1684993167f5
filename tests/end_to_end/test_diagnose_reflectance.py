"""The paper's own story: a sphere at 662 nm, processed with first surface alone, then with what `diagnose` writes."""

import json
from pathlib import Path

import numpy as np
import pytest

from processing.commands.application import main as process
from processing.commands.diagnose import main as diagnose
from processing.diagnosis.surface.diagnose import SurfaceDiagnosis, diagnose_object
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.polarization.image_difference import linear_diattenuation, magnitude, orientation_difference, rmsd
from processing.reflectance.base import load_reflectance
from processing.storage.captures.capture import Capture
from processing.storage.products.product import Product
from simulators.bench.scene import Scene
from simulators.blind import scene_faults
from simulators.blind.sphere_suite import SphereFault, first_surface_of, take
from tests.commands import exit_code

NM, OMEGA_DEG = 662.0, 35.0
FIRST_SURFACE = "kind: first_surface\nname: red print, first surface alone\nconstants:\n  662: {n: 1.30, k: 0.08}\n"


@pytest.fixture(scope="module")
def scene(configs: Path) -> Scene:
    return Scene.load(configs / "scenes/red_sphere.yaml")


def capture(folder: Path, configs: Path, scene: Scene, name: str, seed: int = 1) -> Path:
    declared = InstrumentModel.load(configs / f"instruments/{name}.yaml")
    fault = SphereFault("the paper's", scene, declared, first_surface_of(scene.material))
    path = folder / f"{name}.h5"
    take(path, fault, declared, NM, omega_deg=OMEGA_DEG, seed=seed)
    return path


def errors_of_m0(scene: Scene, material: Path) -> tuple[float, float]:
    """RMS error of psi (degrees) and of |D| (percent) of a material's dominant process against the true one."""
    points = scene.object.geometry.at(OMEGA_DEG, 120, 120).points
    true, model = (
        linear_diattenuation(m.mueller_jones(points, NM)) for m in (scene.material, load_reflectance(material))
    )
    psi = float(np.rad2deg(rmsd(orientation_difference(model, true))))
    return psi, 100 * rmsd(magnitude(model) - magnitude(true))


def error_of_xi0(scene: Scene, product: Path) -> float:
    with Product(product) as opened:
        xi0, valid = opened.get("xi0"), opened.get("valid") > 0
    return rmsd((xi0 - scene.truth(OMEGA_DEG, NM, *xi0.shape).xi0)[valid])


@pytest.mark.long
@pytest.mark.parametrize("name", ["rgb950", "linear_stokes"])
def test_first_surface_lacks_polarized_diffuse(name, configs, scene, tmp_path, capsys):
    path = capture(tmp_path, configs, scene, name)
    stokes = path if name == "linear_stokes" else capture(tmp_path, configs, scene, "linear_stokes", seed=2)
    plain, new = tmp_path / "plain.yaml", tmp_path / "new.yaml"
    plain.write_text(FIRST_SURFACE)
    geometry = configs / "geometries/one_inch_sphere.yaml"
    command = [
        path,
        "--instrument",
        configs / f"instruments/{name}.yaml",
        "--reflectance",
        plain,
        "--geometry",
        geometry,
    ]
    command += ["--write", new, "--json", tmp_path / "d.json", "--report", tmp_path / "d.html"]
    assert exit_code(diagnose, *command) == 0
    text = capsys.readouterr().out
    assert "SIMULATED" in text
    assert "polarized_diffuse" in text
    d = SurfaceDiagnosis.model_validate(json.loads((tmp_path / "d.json").read_text()))
    assert d.verdict == "explained"
    (effect,) = d.effects
    assert effect.kind == "polarized_diffuse"
    assert effect.evidence > 1000
    assert d.constants == pytest.approx({"n": 1.30, "k": 0.08, "a": 0.17, "b": 2.0}, abs=0.05)
    report = (tmp_path / "d.html").read_text()
    assert "<img" in report
    assert "chance that the error of xi0 grows" in report

    # xi0 of the Stokes camera: only the new material is right.
    errors = []
    for material, out in ((plain, tmp_path / "before.h5"), (new, tmp_path / "after.h5")):
        options = ("--geometry", geometry, "--material", material, "--no-figure")
        assert exit_code(process, "xi0", stokes, *options, "--out", out) == 0
        errors.append((*errors_of_m0(scene, material), error_of_xi0(scene, out)))
    (psi, size, xi0), (psi_after, size_after, xi0_after) = errors
    assert (psi, size) == pytest.approx((41, 28), abs=6)
    assert psi_after < 1.0
    assert size_after < 1.0
    assert xi0_after < 0.3 * xi0

    assert exit_code(diagnose, *command) == 2
    assert "exists and is not replaced" in capsys.readouterr().err


@pytest.mark.long
def test_what_acquire_writes_in_stokes_mode_is_enough(acquire, small_rig, configs, tmp_path, capfd):
    rig = small_rig(rows=240, columns=240)
    assert acquire("--omega", 35, "--mode", "stokes", "--rig", rig, "--out", tmp_path)[0] == 0
    (path,) = tmp_path.glob("*.h5")
    plain, out = tmp_path / "plain.yaml", tmp_path / "d.json"
    plain.write_text(FIRST_SURFACE)
    options = ["--reflectance", plain, "--geometry", configs / "geometries/one_inch_sphere.yaml"]
    stokes, mueller = (configs / f"instruments/{name}.yaml" for name in ("linear_stokes", "rgb950"))
    assert exit_code(diagnose, path, "--instrument", stokes, *options, "--json", out) == 0
    d = SurfaceDiagnosis.model_validate(json.loads(out.read_text()))
    assert (d.verdict, [e.kind for e in d.effects]) == ("explained", ["polarized_diffuse"])
    assert d.effects[0].parameters["a"].value == pytest.approx(0.17, abs=3.5 * d.effects[0].parameters["a"].stderr)
    # First surface alone does not know the normal; with what was found a sphere off its place would show.
    assert "registration[sphere]" not in d.unobservable
    capfd.readouterr()
    assert exit_code(diagnose, path, "--instrument", mueller, *options) == 2
    assert "Use the instrument file that belongs to the capture" in capfd.readouterr().err


@pytest.mark.long
def test_geometry_and_instrument_that_were_found_end_the_error(configs, scene, tmp_path, capsys):
    declared = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    moved = scene_faults.ArmZeroFault(scene_faults.moved_sphere(scene, 0.5, -0.3, 0.02), 2.0)
    fault = SphereFault("three", moved, scene_faults.turned_generator(declared, 1.5), scene.material)
    path, new = tmp_path / "c.h5", tmp_path / "new.yaml"
    take(path, fault, declared, NM, omega_deg=OMEGA_DEG, seed=3)
    material = configs / "materials/red_print.yaml"
    geometry = configs / "geometries/one_inch_sphere.yaml"
    options = ["--instrument", configs / "instruments/rgb950.yaml", "--reflectance", material, "--geometry", geometry]
    assert exit_code(diagnose, path, *options, "--write", new) == 0
    assert not new.exists()
    corrected = ViewingGeometry.load(tmp_path / "new.geometry.yaml")
    assert corrected.arm_zero_deg == pytest.approx(2.0, abs=0.4)
    assert corrected.shape.centre_mm[:2] == pytest.approx((0.5, -0.3), abs=0.1)
    instrument = InstrumentModel.load(tmp_path / "new.instrument.yaml")
    with Capture(path) as opened:
        assert opened.header.omega_deg == OMEGA_DEG
    second = diagnose_object([path], instrument, load_reflectance(material), corrected)[0].diagnosis
    assert second.verdict == "consistent"
    assert exit_code(diagnose, path, *options, "--write", new) == 2


def test_both_files_are_needed(configs, tmp_path, capsys):
    code = exit_code(diagnose, tmp_path / "c.h5", "--instrument", "i.yaml", "--reflectance", "m.yaml")
    assert code == 2
    assert "needs both" in capsys.readouterr().err
