"""Several wavelengths in one fit: mounts are shared, optics are not, and values may follow a smooth curve."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from steady_capture import steady_capture

from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.instrument.initial_values import along_wavelengths, first_values
from processing.diagnosis.instrument.mueller_error import mueller_slopes
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.whole_bench import WholeBench
from processing.diagnosis.instrument_file import extend_model
from processing.diagnosis.search.dispersion import curve
from processing.diagnosis.search.fit import Fit, held_out, minimize
from processing.diagnosis.search.result import Correction, Diagnosis, Error
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets
from processing.diagnosis.search.space import Space
from processing.effect import Parameter
from processing.errors import ProcessError
from processing.instrument.changes import Changes, Conditions
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.polarization import mueller

ANGLES = {"psg": np.arange(0, 180, 5.0)}
WAVELENGTHS = (500.0, 600.0, 700.0)
#: Truth: one azimuth of each plate, and a retardance at each wavelength.
AZIMUTHS = {"psg_retarder": 63.0, "psa_retarder": -41.0}
RETARDANCES = {500.0: 118.0, 600.0: 95.0, 700.0: 80.0}
#: Many wavelengths, of which the values follow a smooth curve.
SPECTRUM = tuple(np.linspace(500.0, 900.0, 9).tolist())
SPECTRUM_ANGLES = {"psg": np.arange(0, 180, 7.5)}
ONE = (Parameter("p", "degree", -100, 100, 1.0),)


def train(
    retardances_deg: tuple[float, float] = (90, 90), free_source: bool | None = False, **declared: object
) -> InstrumentModel:
    polarizers = [{"kind": "polarizer", "name": n, "azimuth_deg": a} for n, a in (("left", 0), ("right", 90))]
    psg, psa = (
        {"kind": "retarder", "name": name, "axis": "psg", "retardance_deg": retardance}
        for name, retardance in zip(AZIMUTHS, retardances_deg, strict=True)
    )
    return InstrumentModel.model_validate(
        {
            "name": "two plates and a beam splitter",
            "generator": [{"kind": "polarizer", "name": "polarizer"}, psg],
            "analyzer": [psa | {"ratio": 5}],
            "channels": [{"name": p["name"], "elements": [p | {"name": f"p_{p['name']}"}]} for p in polarizers],
            "calibrate": [f"{n}.{f}" for n in AZIMUTHS for f in ("azimuth_deg", "retardance_deg")],
            "free_source": free_source,
            **declared,
        }
    )


def captured(model: InstrumentModel, wavelength_nm: float, angles, retardances, gain=1.0, noise=0.0) -> CaptureData:
    """Of air, by a train of these retardances of its plates."""
    values = {n: {"azimuth_deg": a} for n, a in AZIMUTHS.items()}
    for name, retardance in retardances.items():
        values[name]["retardance_deg"] = retardance
    conditions, air = Conditions.of(angles, ("left", "right")), np.eye(4).reshape(16)
    w = model.with_values(values).rows(angles, Changes(conditions))
    error = np.random.default_rng(int(wavelength_nm)).normal(0.0, noise, w.shape[:2])
    signal = (0.4 * (w @ air + error) * np.reshape(gain, (-1, 1)))[..., None, None]
    of_one = steady_capture(signal[:, 0], 1e-4, sample=air)
    return replace(of_one, signal=signal.astype(np.float32), conditions=conditions, wavelength_nm=wavelength_nm)


def captured_at(model: InstrumentModel, wavelength_nm: float, gain: np.ndarray | float = 1.0) -> CaptureData:
    return captured(model, wavelength_nm, ANGLES, dict.fromkeys(AZIMUTHS, RETARDANCES[wavelength_nm]), gain)


@pytest.fixture
def problem() -> InstrumentProblem:
    model = train()
    return InstrumentProblem([model.at(w) for w in WAVELENGTHS], [captured_at(model, w) for w in WAVELENGTHS], folds=1)


def retardance_deg(wavelength_nm: float) -> float:
    """Of a plate that is a half wave in the middle of the spectrum: there its two senses meet."""
    return 180 * 660 / wavelength_nm


def spectrum_of(**declared: object) -> InstrumentProblem:
    model = train((180, 100), None, **declared)
    data = [captured(model, w, SPECTRUM_ANGLES, {"psg_retarder": retardance_deg(w)}, noise=1e-4) for w in SPECTRUM]
    return InstrumentProblem([model.at(w) for w in SPECTRUM], data, folds=1)


@pytest.fixture(scope="module")
def spectrum() -> InstrumentProblem:
    return spectrum_of()


def test_mounts_are_shared_and_optics_are_not(problem):
    candidates = problem.pool()
    count = {k: sum(c.kind == k for c in candidates) for k in {c.kind for c in candidates}}
    assert count["rotation_eccentricity"] == 1
    assert count["retarder_diattenuation"] == 2 * len(WAVELENGTHS)
    assert count["source_drift"] == len(WAVELENGTHS)
    nominal = problem.nominal()
    assert sum(c.place == "psg_retarder.azimuth_deg" for c in nominal) == 1
    assert sum(c.place == "psg_retarder.retardance_deg" for c in nominal) == len(WAVELENGTHS)


def test_a_train_far_off_is_found_wavelength_by_wavelength(problem):
    base = Space(problem.nominal())
    start = along_wavelengths(problem, base, lambda line: None)
    values = np.concatenate([start[c] for c in base.candidates])
    assert minimize(problem, base, values).rms < 1e-4
    # A plate seen from its slow axis, or half a turn on, is the same plate.
    at = {(c.place, c.wavelength_nm): float(start[c][0]) for c in base.candidates}
    for wavelength, truth in RETARDANCES.items():
        for name in AZIMUTHS:
            fitted = 90 + at[f"{name}.retardance_deg", wavelength]
            assert abs(np.cos(np.deg2rad(fitted)) - np.cos(np.deg2rad(truth))) < 1e-3


@pytest.mark.parametrize(
    ("name", "kinds", "step_of_values"),
    [
        ("problem", ("rotation_eccentricity",), 1),
        ("spectrum", ("generator_ellipticity", "rotation_eccentricity", "channel_gain"), 4),
    ],
)
def test_gradient_of_shared_values_own_values_and_coefficients(name, kinds, step_of_values, request):
    problem = request.getfixturevalue(name)
    space = Space((*problem.nominal(), *(c for c in problem.pool() if c.kind in kinds)))
    at = np.random.default_rng(1).uniform(-1, 1, space.size) * 0.1 * space.joined("typical")
    gradient = 2 * problem.sums(space, at).gradient.sum(axis=0)
    for j in range(0, space.size, step_of_values):
        step = np.zeros(space.size)
        step[j] = 1e-4 * space.joined("typical")[j]
        up, down = (problem.sums(space, at + s, derivatives=False).excess.sum() for s in (step, -step))
        # The projection after Kaufman leaves out a term in the residual.
        assert gradient[j] == pytest.approx((up - down) / (2 * step[j]), rel=0.02, abs=0.02 * np.abs(gradient).max())


def test_a_free_source_leaves_no_residual():
    gain = np.random.default_rng(3).uniform(0.5, 1.5, ANGLES["psg"].size)
    residuals = {}
    for free in (False, True):
        model = train(free_source=free)
        values = {n: {"azimuth_deg": a, "retardance_deg": RETARDANCES[600.0]} for n, a in AZIMUTHS.items()}
        problem = InstrumentProblem(model.with_values(values).at(600.0), [captured_at(model, 600.0, gain)], folds=1)
        sums = problem.sums(Space(()), np.zeros(0), derivatives=False)
        residuals[free] = float(np.sqrt(sums.square.sum() / sums.count.sum()))
        # One value of two is left over in each state.
        assert sums.count.sum() == pytest.approx(gain.size if free else 2 * gain.size - 1)
    assert residuals[True] < 1e-5
    assert residuals[False] > 0.1
    # What changes both channels of a state alike is taken up too.
    assert not any(c.kind.startswith("source") or c.kind.endswith("transmission") for c in problem.pool())


def test_what_the_intensities_do_not_tell_of_m_is_no_error_of_the_instrument(problem):
    space = Space(tuple(c for c in problem.pool() if c.kind == "rotation_eccentricity"))
    values = np.zeros(space.size)

    def of_all(remainder=None):
        return sum(products.sum(axis=0) for _, products, _ in mueller_slopes(problem, space, values, remainder))

    full, half, none = (of_all(np.full(3, x)) for x in (1.0, 1e3, 1e9))
    assert full == pytest.approx(of_all())
    assert np.trace(none) < 1e-6 * np.trace(full)
    assert 0.01 < np.trace(half) / np.trace(full) < 0.99


def one_run(wavelengths) -> InstrumentProblem:
    """Of a spectrograph: the angles of its states are the same at all wavelengths."""
    model = train(free_source=True).model_copy(update={"calibrate": (), "belongs_to": {"angle_per_state": "mechanics"}})
    return InstrumentProblem([model.at(w) for w in wavelengths], [captured_at(model, w) for w in wavelengths])


@pytest.mark.parametrize(("wavelengths", "doubted"), [(WAVELENGTHS, False), (WAVELENGTHS[:2], False), ((600.0,), True)])
def test_angles_that_wavelengths_share_are_told_by_all_of_their_ratios(wavelengths, doubted):
    """One angle for one ratio of two channels explains anything; one for three of them does not."""
    problem = one_run(wavelengths)
    angles = tuple(c for c in problem.pool() if c.kind == "angle_per_state")
    assert len(angles) == 1
    bench = WholeBench(problem, lambda line: None)
    posterior = SimpleNamespace(space=Space(angles), members=((0,),), samples=SimpleNamespace(probability=np.ones(1)))
    assert bench.as_many_as_intensities(posterior, 0.5) == (set(angles) if doubted else set())


def test_what_shared_angles_take_away_is_taken_from_every_capture():
    problem = one_run(WAVELENGTHS)
    space = Space(tuple(c for c in problem.pool() if c.kind == "angle_per_state"))
    values = np.zeros(space.size)
    sums = problem.sums(space, values)
    check = held_out(problem, space, Fit(values, sums, float(sums.excess.sum())))
    assert check.count < sums.count.sum() - 0.9 * space.size
    assert check.shares[:, 1].sum() == pytest.approx(check.count)


def test_sets_are_weighed_beside_far_steeper_directions():
    # Photon noise of 1e-5 makes some directions 1e16 times steeper than what the prior holds.
    random = np.random.default_rng(0)
    turn, _ = np.linalg.qr(random.normal(size=(40, 40)))
    h = (turn * np.logspace(16, -6, 40)) @ turn.T
    form = Quadratic(0.0, np.zeros(40), (h + h.T) / 2)
    sets = Sets(form, [Group(np.arange(39), always=True, fixed_tau=10.0), Group(np.array([39]))], Noise(True, 10.0))
    assert np.isfinite(sets.fitted(sets.empty()).score)


def test_a_free_source_needs_two_channels():
    declared = train().model_dump() | {"channels": [{"name": "camera"}], "free_source": True}
    with pytest.raises(ValueError, match="two channels"):
        InstrumentModel.model_validate(declared)


def diagnosis(values: dict[str, EffectParameter], effects: tuple[AppliedEffect, ...]) -> Diagnosis:
    error = Error(rms_percent=1.0, chi2_reduced=1.0, held_out="")
    return Diagnosis(
        verdict="explained",
        error_before=error,
        error_after=error,
        noise_floor_percent=None,
        effects=(),
        unobservable=(),
        recommendation="",
        unexplained=None,
        calibrated=values,
        ranking=(),
        captures=(),
        instrument="",
        wavelengths_nm=(500.0, 600.0),
        simulated=True,
        correction=Correction(effects=effects),
    )


def test_the_file_has_a_value_for_each_wavelength_and_mechanics_for_all():
    mount = EffectParameter(value=3.0, stderr=0.1, unit="degree")
    plate = EffectParameter(value=(118.0, 95.0), stderr=(0.1, 0.1), unit="degree", wavelengths_nm=(500.0, 600.0))
    terms = {n: EffectParameter(value=0.1, unit="degree") for n in ("cos_1", "sin_1", "cos_2", "sin_2")}
    eccentric = AppliedEffect(kind="rotation_eccentricity", element="psg", parameters=terms)
    drawn = {"psg_retarder.azimuth_deg": mount, "psg_retarder.retardance_deg": plate}
    written = extend_model(train(), diagnosis(drawn, (eccentric,)))
    assert written.at(500.0).generator[1].retardance_deg == 118.0
    assert written.at(600.0).generator[1].azimuth_deg == 3.0
    # At another wavelength the mechanics hold, and what is nominal anyway starts from the neighbours.
    between = written.nominal_at(550.0)
    assert between.generator[1].retardance_deg == pytest.approx(106.5)
    assert between.generator[1].azimuth_deg == 3.0
    assert [e.kind for e in between.effects] == ["rotation_eccentricity"]


def test_a_free_source_is_free_in_every_tile_of_an_image():
    model, nm = train(free_source=True), 600.0
    random = np.random.default_rng(3)
    steady, floor = captured_at(model, nm).signal, 1e-6
    noise = random.normal(0, np.sqrt(floor), (*steady.shape[:2], 24, 24))
    gain = random.uniform(0.5, 2.0, len(steady))
    sums = []
    for level in (np.ones(len(gain)), gain):
        data = replace(
            captured_at(model, nm),
            signal=((steady + noise) * level[:, None, None, None]).astype(np.float32),
            floor=floor * level**2,
            usable=np.ones((24, 24), dtype=bool),
            clipped=np.zeros((24, 24), dtype=bool),
        )
        problem = InstrumentProblem([model.at(nm)], [data])
        varying = [c for c in problem.pool() if c.kind in ("field_retardance", "retarder_diattenuation")]
        space = Space(tuple(varying))
        sums.append(problem.sums(space, 0.2 * space.joined("typical")))
    assert {c.kind for c in space.candidates} >= {"field_retardance"}
    for name in ("excess", "gradient", "curvature"):
        expected = getattr(sums[0], name)
        assert getattr(sums[1], name) == pytest.approx(expected, rel=1e-3, abs=1e-4 * np.abs(expected).max()), name


def test_a_smooth_curve_needs_fewer_coefficients_than_wavelengths() -> None:
    smooth = curve(SPECTRUM, ONE)
    assert smooth.basis.shape[1] < len(SPECTRUM)
    values = np.array([[retardance_deg(w) - 180] for w in SPECTRUM])
    coefficients = smooth.through(values)
    assert np.allclose([smooth.at(w) @ coefficients for w in SPECTRUM], values, atol=0.1)


def test_few_wavelengths_have_a_value_each() -> None:
    assert curve((451.0, 529.0, 589.0, 662.0), ONE) is None


def test_neighbours_are_alike_and_what_is_far_is_not() -> None:
    basis = curve(tuple(np.geomspace(400.0, 1600.0, 30).tolist()), ONE).basis
    alike = basis @ basis.T
    assert np.allclose(np.diag(alike), 1.0, atol=1e-4)
    assert alike[0, 1] > 0.98
    assert abs(alike[0, -1]) < 1e-3


def test_a_train_far_off_is_followed_through_a_half_wave(spectrum) -> None:
    base = Space(spectrum.nominal())
    start = first_values(spectrum, base, spectrum.pool(), lambda line: None)
    values = np.concatenate([start[c] for c in base.candidates])
    sums = spectrum.sums(base, values, derivatives=False)
    assert sums.excess.sum() < 5 * np.sqrt(2 * sums.freedom.sum())
    plate = next(c for c in base.candidates if c.place == "psg_retarder.retardance_deg")
    retardances = [180 + v[0] for _, v, _ in plate.by_wavelength(start[plate], np.eye(plate.size))]
    truth = np.array([retardance_deg(w) for w in SPECTRUM])
    # The same plate in the other sense, at all wavelengths: it never turns back.
    assert min(np.abs(retardances - truth).max(), np.abs(360 - np.array(retardances) - truth).max()) < 0.2


def test_the_file_says_what_is_shared() -> None:
    declared = {"psg_retarder.azimuth_deg": "dispersion", "rotation_slip": "mechanics", "path_retardance": "wavelength"}
    problem = spectrum_of(belongs_to=declared)
    candidates = problem.pool()
    assert all(c.curve is None for c in candidates if c.kind == "path_retardance")
    assert sum(c.kind == "path_retardance" for c in candidates) == len(SPECTRUM)
    slips = [c for c in candidates if c.kind == "rotation_slip"]
    assert {c.capture for c in slips} == {None}
    assert len(slips) < 2 * SPECTRUM_ANGLES["psg"].size
    azimuths = [c for c in problem.nominal() if c.place == "psg_retarder.azimuth_deg"]
    assert len(azimuths) == 1
    assert azimuths[0].curve is not None


def test_what_is_declared_has_to_exist() -> None:
    with pytest.raises(ProcessError, match="rotation_slide is neither"):
        spectrum_of(belongs_to={"rotation_slide": "mechanics"}).pool()


def test_depolarization_is_the_mean_over_retardances() -> None:
    retardance, width = np.deg2rad(130.0), np.deg2rad(12.0)
    each = np.random.default_rng(0).normal(retardance, width, 200_000)
    lost = 1 - np.exp(-(width**2) / 2)
    mean = mueller.retarder(0.3, each).mean(axis=0)
    assert np.allclose(mueller.retarder(0.3, retardance, lost), mean, atol=2e-3)
