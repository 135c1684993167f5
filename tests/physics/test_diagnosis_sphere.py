"""What `diagnose --reflectance` finds on spheres with one thing wrong, and that it keeps silent where nothing is."""

from pathlib import Path

import numpy as np
import pytest

from processing.diagnosis.search.correction import solution
from processing.diagnosis.search.posterior import fit_posterior
from processing.diagnosis.search.space import Space
from processing.diagnosis.surface.data import read_surface
from processing.diagnosis.surface.diagnose import SurfaceDiagnosis, diagnose_object, widen_errors
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.reflectance.effects.base import ReflectanceEffect
from processing.storage.captures.capture import Capture
from simulators.bench.scattering_laws import Xi0Law
from simulators.bench.scene import Scene
from simulators.blind import scene_faults
from simulators.blind.sphere_suite import SphereFault, drawn, take

NM, OMEGA_DEG = 662.0, 35.0


@pytest.fixture(scope="module")
def scene(configs: Path) -> Scene:
    return Scene.load(configs / "scenes/red_sphere.yaml")


@pytest.fixture(scope="module", params=["rgb950", "linear_stokes"])
def declared(configs: Path, request: pytest.FixtureRequest) -> InstrumentModel:
    return InstrumentModel.load(configs / f"instruments/{request.param}.yaml")


def diagnosed(
    folder: Path, fault: SphereFault, declared: InstrumentModel, scene: Scene, seed: int = 1
) -> tuple[SurfaceDiagnosis, SurfaceProblem]:
    path = folder / "capture.h5"
    path.unlink(missing_ok=True)
    take(path, fault, declared, NM, omega_deg=OMEGA_DEG, seed=seed)
    judged, problem = diagnose_object([path], declared, fault.material, scene.object.geometry)
    return judged.diagnosis, problem


def test_a_true_model_is_left_in_peace(scene, declared, tmp_path):
    fault = drawn("none", np.random.default_rng(1), scene, declared)
    d, _ = diagnosed(tmp_path, fault, declared, scene)
    assert d.verdict == "consistent"
    assert not d.effects
    # Chi-square of some thousand degrees of freedom at least.
    assert d.error_before.chi2_reduced == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    ("instrument", "kind"),
    [
        pytest.param("rgb950", "registration", marks=pytest.mark.long),
        pytest.param("rgb950", "illumination_azimuth", marks=pytest.mark.long),
        ("linear_stokes", "analyzer_roll"),
    ],
)
def test_what_is_wrong_gets_its_name(scene, configs, tmp_path, instrument, kind):
    declared = InstrumentModel.load(configs / f"instruments/{instrument}.yaml")
    fault = drawn(kind, np.random.default_rng(11), scene, declared)
    d, _ = diagnosed(tmp_path, fault, declared, scene)
    assert d.verdict == "explained"
    (effect,) = d.effects
    assert effect.kind == kind
    # A linear Stokes camera cannot exclude that the small eigenvalues differ, unless the effect is a large one.
    # Channels that are each turned by the same are an analyzer that is turned.
    also = {"channel_azimuth"} if kind == "analyzer_roll" else set()
    assert set(effect.indistinguishable_from) <= ({"not_triply_degenerate", *also} if declared.mosaic else set())
    for name, truth in fault.parameters[kind].items():
        estimate = effect.parameters[name]
        assert estimate.value == pytest.approx(truth, abs=3.5 * estimate.stderr)
    assert d.error_after.rms_percent < 1.05 * d.noise_floor_percent
    # A small fault is well under the noise of a pixel and plain over all of them.
    assert d.error_after.rms_percent < d.error_before.rms_percent
    assert effect.evidence > 50


@pytest.mark.long
def test_arm_zero_and_registration_cannot_be_told_apart_by_linear_stokes(scene, configs, tmp_path):
    declared = InstrumentModel.load(configs / "instruments/linear_stokes.yaml")
    fault = SphereFault("arm_zero", scene_faults.ArmZeroFault(scene, 2.0), declared, scene.material)
    d, _ = diagnosed(tmp_path, fault, declared, scene)
    (effect,) = d.effects
    named = {effect.kind, *(i.partition("[")[0] for i in effect.indistinguishable_from)}
    assert named == {"arm_zero", "registration", "not_triply_degenerate"}
    assert "outline" in d.recommendation
    # A full Mueller capture with the same light sees the angle of incidence at each facet, and so the arm itself.
    declared = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    fault = SphereFault("arm_zero", scene_faults.ArmZeroFault(scene, 2.0), declared, scene.material)
    d, _ = diagnosed(tmp_path, fault, declared, scene)
    (effect,) = d.effects
    assert (effect.kind, effect.indistinguishable_from) == ("arm_zero", ())


@pytest.mark.long
def test_light_from_the_support_is_interreflection(scene, configs, tmp_path):
    declared = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    fault = SphereFault("interreflection", scene_faults.LitSupport(scene, 0.3), declared, scene.material)
    d, _ = diagnosed(tmp_path, fault, declared, scene)
    (effect,) = d.effects
    assert (effect.kind, effect.element) == ("interreflection", "support")
    assert d.verdict in ("explained", "partly_explained")


@pytest.mark.parametrize(
    ("instrument", "kind"),
    [
        ("linear_stokes", "dented"),
        pytest.param("rgb950", "not_degenerate", marks=pytest.mark.long),
        pytest.param("rgb950", "slow_turn", marks=pytest.mark.long),
    ],
)
def test_what_is_not_in_the_list_gets_no_name(scene, configs, tmp_path, instrument, kind):
    declared = InstrumentModel.load(configs / f"instruments/{instrument}.yaml")
    fault = drawn(kind, np.random.default_rng(4), scene, declared)
    d, _ = diagnosed(tmp_path, fault, declared, scene)
    assert d.verdict == "unexplained"
    assert not d.effects
    assert d.unexplained is not None
    assert d.unexplained.description


@pytest.mark.long
def test_two_effects_at_once(scene, configs, tmp_path):
    declared = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    arm = scene_faults.ArmZeroFault(scene, 2.0)
    fault = SphereFault("two", arm, scene_faults.turned_generator(declared, 1.0), scene.material)
    d, _ = diagnosed(tmp_path, fault, declared, scene)
    estimates = {e.kind: next(iter(e.parameters.values())) for e in d.effects}
    assert set(estimates) == {"arm_zero", "illumination_azimuth"}
    assert estimates["arm_zero"].value == pytest.approx(2.0, abs=3.5 * estimates["arm_zero"].stderr)
    assert estimates["illumination_azimuth"].value == pytest.approx(
        1.0, abs=3.5 * estimates["illumination_azimuth"].stderr
    )


@pytest.mark.parametrize(("omega_deg", "light"), [(102.0, 1.0), (60.0, 0.1)])
def test_an_index_where_little_is_polarized_has_an_honest_error(scene, configs, tmp_path, omega_deg, light):
    # Horizontal light at 102 degrees: p-polarized at the Brewster angle, nearly nothing comes back.
    declared = InstrumentModel.load(configs / "instruments/linear_stokes.yaml")
    fault = drawn("refractive_index", np.random.default_rng(5), scene, declared)
    path = tmp_path / "capture.h5"
    take(path, fault, declared, NM, omega_deg=omega_deg, seed=3, light=light)
    with Capture(path) as capture:
        data = read_surface(capture, declared.at(NM), scene.object.geometry, fault.material)
    problem = SurfaceProblem(declared.at(NM), [data])
    space = Space(tuple(c for c in problem.pool() if c.kind == "refractive_index"))
    posterior = fit_posterior(problem, space, (), [np.zeros(2)], say=lambda line: None)
    solved = solution(problem, posterior, Space(()), np.zeros(0))
    error = np.sqrt(np.diag(widen_errors(problem, posterior, solved)[1]))
    truth = np.array([fault.parameters["refractive_index"][n] for n in ("n", "k")])
    assert np.all(np.abs(posterior.values - truth) < 3.5 * error)
    assert error[0] < 0.05


def test_without_polarization_there_is_nothing_to_say(scene, configs, tmp_path):
    declared = InstrumentModel.load(configs / "instruments/linear_stokes.yaml")
    white = {nm: s.model_copy(update={"xi0": Xi0Law(base=0.25)}) for nm, s in scene.object.surface.items()}
    fault = SphereFault(
        "white", Scene(scene.object.model_copy(update={"surface": white}), scene.material), declared, None
    )
    path = tmp_path / "capture.h5"
    take(path, fault, declared, NM, omega_deg=OMEGA_DEG, seed=1)
    with pytest.raises(ProcessError, match="no polarization stands out of the noise"):
        diagnose_object([path], declared, scene.material, scene.object.geometry)


def test_derivatives_are_those_of_the_residual(scene, configs, tmp_path):
    declared = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    fault = drawn("polarized_diffuse", np.random.default_rng(1), scene, declared)
    path = tmp_path / "capture.h5"
    take(path, fault, declared, NM, omega_deg=OMEGA_DEG, seed=1)
    with Capture(path) as capture:
        data = read_surface(capture, declared.at(NM), scene.object.geometry, fault.material)
    problem = SurfaceProblem(declared.at(NM), [data])
    pool = [c for c in problem.pool() if isinstance(c.effect, ReflectanceEffect)]
    space = Space(tuple(pool))
    values = 0.5 * np.minimum(space.joined("typical"), space.joined("upper"))
    sums = problem.sums(space, values)
    for j in range(space.size):
        step = 1e-3 * space.joined("typical")[j]
        moved = [values.copy(), values.copy()]
        moved[0][j] -= step
        moved[1][j] += step
        low, high = (problem.sums(space, v, derivatives=False).excess.sum() for v in moved)
        scale = np.sqrt(sums.curvature.sum(axis=0)[j, j] * abs(sums.excess.sum()))
        # Kaufman's derivative leaves out a part that the gradient of the sum of squares does not have.
        assert (high - low) / (4 * step) == pytest.approx(sums.gradient.sum(axis=0)[j], abs=2e-3 * scale)


def test_an_object_out_of_view_is_refused(scene, configs, tmp_path):
    declared = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    fault = drawn("none", np.random.default_rng(1), scene, declared)
    path = tmp_path / "capture.h5"
    take(path, fault, declared, NM, omega_deg=OMEGA_DEG, seed=1)
    geometry = scene.object.geometry
    far = geometry.shape.model_copy(update={"centre_mm": (400.0, 0.0, 0.0)})
    with pytest.raises(ProcessError, match="no pixel sees a lit point"):
        diagnose_object([path], declared, scene.material, geometry.model_copy(update={"shape": far}))
