"""Values that follow a smooth curve over many wavelengths: few coefficients, one value told at each wavelength."""

from dataclasses import replace

import numpy as np
import pytest
from steady_capture import steady_capture

from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.instrument.initial_values import first_values
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.dispersion import curve
from processing.diagnosis.search.space import Space
from processing.effect import Parameter
from processing.errors import ProcessError
from processing.instrument.changes import Changes, Conditions
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller

ANGLES = {"psg": np.arange(0, 180, 7.5)}
WAVELENGTHS = tuple(np.linspace(500.0, 900.0, 9).tolist())
AZIMUTHS = {"psg_retarder": 63.0, "psa_retarder": -41.0}
ONE = (Parameter("p", "degree", -100, 100, 1.0),)


def retardance_deg(wavelength_nm: float) -> float:
    """Of a plate that is a half wave in the middle of the range: there its two senses meet."""
    return 180 * 660 / wavelength_nm


def train(belongs_to: dict[str, str] | None = None) -> InstrumentModel:
    polarizers = [{"kind": "polarizer", "name": n, "azimuth_deg": a} for n, a in (("left", 0), ("right", 90))]
    plates = {name: {"kind": "retarder", "name": name, "axis": "psg", "retardance_deg": 180} for name in AZIMUTHS}
    return InstrumentModel.model_validate(
        {
            "name": "two plates and a beam splitter",
            "generator": [{"kind": "polarizer", "name": "polarizer"}, plates["psg_retarder"]],
            "analyzer": [plates["psa_retarder"] | {"ratio": 5, "retardance_deg": 100}],
            "channels": [{"name": p["name"], "elements": [p | {"name": f"p_{p['name']}"}]} for p in polarizers],
            "calibrate": [f"{n}.{f}" for n in AZIMUTHS for f in ("azimuth_deg", "retardance_deg")],
            "belongs_to": belongs_to or {},
        }
    )


def captured(model: InstrumentModel, wavelength_nm: float) -> CaptureData:
    values = {n: {"azimuth_deg": a} for n, a in AZIMUTHS.items()}
    values["psg_retarder"]["retardance_deg"] = retardance_deg(wavelength_nm)
    conditions, air = Conditions.of(ANGLES, ("left", "right")), np.eye(4).reshape(16)
    w = model.with_values(values).rows(ANGLES, Changes(conditions))
    noise = np.random.default_rng(int(wavelength_nm)).normal(0.0, 1e-4, w.shape[:2])
    signal = (0.4 * (w @ air) + noise)[..., None, None]
    of_one = steady_capture(signal[:, 0], 1e-4, sample=air)
    return replace(of_one, signal=signal.astype(np.float32), conditions=conditions, wavelength_nm=wavelength_nm)


def problem_of(model: InstrumentModel) -> InstrumentProblem:
    return InstrumentProblem([model.at(w) for w in WAVELENGTHS], [captured(model, w) for w in WAVELENGTHS], folds=1)


@pytest.fixture(scope="module")
def problem() -> InstrumentProblem:
    return problem_of(train())


def test_a_smooth_curve_needs_fewer_coefficients_than_wavelengths() -> None:
    smooth = curve(WAVELENGTHS, ONE)
    assert smooth.basis.shape[1] < len(WAVELENGTHS)
    values = np.array([[retardance_deg(w) - 180] for w in WAVELENGTHS])
    coefficients = smooth.through(values)
    assert np.allclose([smooth.at(w) @ coefficients for w in WAVELENGTHS], values, atol=0.1)


def test_few_wavelengths_have_a_value_each() -> None:
    assert curve((451.0, 529.0, 589.0, 662.0), ONE) is None


def test_neighbours_are_alike_and_what_is_far_is_not() -> None:
    basis = curve(tuple(np.geomspace(400.0, 1600.0, 30).tolist()), ONE).basis
    alike = basis @ basis.T
    assert np.allclose(np.diag(alike), 1.0, atol=1e-4)
    assert alike[0, 1] > 0.98
    assert abs(alike[0, -1]) < 1e-3


def test_a_train_far_off_is_followed_through_a_half_wave(problem) -> None:
    base = Space(problem.nominal())
    start = first_values(problem, base, problem.pool(), lambda line: None)
    values = np.concatenate([start[c] for c in base.candidates])
    sums = problem.sums(base, values, derivatives=False)
    assert sums.excess.sum() < 5 * np.sqrt(2 * sums.freedom.sum())
    plate = next(c for c in base.candidates if c.place == "psg_retarder.retardance_deg")
    retardances = [180 + v[0] for _, v, _ in plate.by_wavelength(start[plate], np.eye(plate.size))]
    truth = np.array([retardance_deg(w) for w in WAVELENGTHS])
    # The same plate in the other sense, at all wavelengths: it never turns back.
    assert min(np.abs(retardances - truth).max(), np.abs(360 - np.array(retardances) - truth).max()) < 0.2


def test_gradient_by_coefficients(problem) -> None:
    kinds = ("generator_ellipticity", "rotation_eccentricity", "channel_gain")
    space = Space((*problem.nominal(), *(c for c in problem.pool() if c.kind in kinds)))
    at = np.random.default_rng(1).uniform(-1, 1, space.size) * 0.1 * space.joined("typical")
    gradient = 2 * problem.sums(space, at).gradient.sum(axis=0)
    for j in range(0, space.size, 4):
        step = np.zeros(space.size)
        step[j] = 1e-4 * space.joined("typical")[j]
        up, down = (problem.sums(space, at + s, derivatives=False).excess.sum() for s in (step, -step))
        # The projection after Kaufman leaves out a term in the residual.
        assert gradient[j] == pytest.approx((up - down) / (2 * step[j]), rel=0.02, abs=0.02 * np.abs(gradient).max())


def test_the_file_says_what_is_shared() -> None:
    declared = {"psg_retarder.azimuth_deg": "dispersion", "rotation_slip": "mechanics", "path_retardance": "wavelength"}
    problem = problem_of(train(declared))
    candidates = problem.pool()
    assert all(c.curve is None for c in candidates if c.kind == "path_retardance")
    assert sum(c.kind == "path_retardance" for c in candidates) == len(WAVELENGTHS)
    slips = [c for c in candidates if c.kind == "rotation_slip"]
    assert {c.capture for c in slips} == {None}
    assert len(slips) < 2 * ANGLES["psg"].size
    azimuths = [c for c in problem.nominal() if c.place == "psg_retarder.azimuth_deg"]
    assert len(azimuths) == 1
    assert azimuths[0].curve is not None


def test_what_is_declared_has_to_exist() -> None:
    with pytest.raises(ProcessError, match="rotation_slide is neither"):
        problem_of(train({"rotation_slide": "mechanics"})).pool()


def test_depolarization_is_the_mean_over_retardances() -> None:
    retardance, width = np.deg2rad(130.0), np.deg2rad(12.0)
    each = np.random.default_rng(0).normal(retardance, width, 200_000)
    lost = 1 - np.exp(-(width**2) / 2)
    mean = mueller.retarder(0.3, each).mean(axis=0)
    assert np.allclose(mueller.retarder(0.3, retardance, lost), mean, atol=2e-3)
