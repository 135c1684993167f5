"""The detector's noise is found from the images themselves, told where it is not as declared, and then counted with."""

import numpy as np
import pytest
from bench_capture import bench_capture
from scipy.ndimage import gaussian_filter
from steady_capture import steady_capture

from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.captures.noise import compare_scatter, detector_noise
from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.captures.screening import screen_capture
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.structure import compute_residual
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit, minimize
from processing.diagnosis.search.space import Space
from processing.instrument.applied_effects import instrument_effects
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from simulators.blind.detector_cases import DETECTOR
from simulators.blind.undeclared_captures import TrueBench, declared_bench

STATES = 40
OPTICS = "instruments/rgb950.yaml"


@pytest.fixture
def bench_file(tmp_path, configs):
    def capture(bench: TrueBench, air: bool, states: int = STATES):
        return bench_capture(tmp_path, configs / OPTICS, bench, air, states, seed=3)

    return capture


def read(path, configs) -> tuple[CaptureData, dict[str, float], float]:
    """The screened capture, the tests of its residual against the model as declared, and chi-square."""
    model = InstrumentModel.load(configs / OPTICS).at(662)
    with Capture(path) as capture:
        data = screen_capture(read_capture(capture, model), model, lambda line: None)
    problem = InstrumentProblem(model, [data])
    fit = minimize(problem, Space(()), np.zeros(0))
    tests = compute_residual(problem, 0, Space(()), fit).tests
    return data, tests, float(1 + fit.sums.excess.sum() / fit.sums.freedom.sum())


def spoiled(name: str, seed: int, **bench) -> TrueBench:
    out = TrueBench(**{"rows": 40, "columns": 40} | bench)
    if name in DETECTOR:
        DETECTOR[name](out, np.random.default_rng(seed), STATES)
    elif name == "row_noise_10_e":
        out.noise.append(lambda e, r: e + 10.0 * r.standard_normal((*e.shape[:2], 1)))
    return out


def dark_margin(state: int, electrons):
    """The light, with a part of the image beside the object."""
    return np.where(np.arange(electrons.shape[-1]) < 12, 0.01, 1.0) * electrons


@pytest.mark.parametrize("air", [True, False])
@pytest.mark.parametrize(
    ("name", "bench", "words"),
    [
        ("nothing", {}, None),
        ("gain_misstated", {}, "of a gain of 0.5"),
        ("gain_not_stated", {}, None),
        ("resampled", {}, "resampled"),
        ("row_noise_10_e", {}, "every row of a frame"),
        ("read_noise_doubled", {"electrons": 400.0}, "as of a read noise of"),
        ("black_jitter", {"light": [dark_margin]}, "the black level is another one in every frame"),
    ],
)
def test_noise_is_told_and_does_not_alarm(bench_file, configs, name, bench, words, air):
    data, tests, chi2 = read(bench_file(spoiled(name, 3, **bench), air), configs)
    assert len(data.told_of_noise) == (words is not None), data.told_of_noise
    assert words is None or words in data.told_of_noise[0], data.told_of_noise
    if name == "black_jitter":
        # 3 electrons, of 2 counts each.
        assert float(data.told_of_noise[0].split()[-3]) == pytest.approx(6.0, rel=0.25)
    assert data.noise_estimated == (name == "gain_not_stated")
    assert max(tests.values()) < 5, tests
    assert chi2 == pytest.approx(1.0, abs=0.03)


def test_optics_are_judged_with_the_noise_that_is_found(bench_file, configs):
    """A gain that is misstated, beside a plate 2 degrees off: both are told, each as what it is."""
    bench = spoiled("gain_misstated", 3, rows=24, columns=24, dg=np.deg2rad(127.12 + 2.0))
    judged, _ = diagnose_captures([bench_file(bench, air=True, states=18)], InstrumentModel.load(configs / OPTICS))
    d = judged.diagnosis
    assert d.noise is not None
    assert d.noise.verdict == "not_as_declared"
    assert d.verdict == "explained"
    (effect,) = d.effects
    assert (effect.kind, effect.confident) == ("psg_retardance", True)
    assert d.error_after.chi2_reduced == pytest.approx(1.0, abs=0.03)


def test_a_fault_of_the_optics_is_no_noise(bench_file, configs):
    """Not an image that wanders, a bent response, a source that flickers, or all of them."""
    bench = TrueBench(rows=40, columns=40, og=np.deg2rad(-16.0))
    bench.level.append(lambda k, a: 1 + 0.02 * np.sin(1.7 * k**2))
    bench.shift.append(lambda k, a: (0.4 * np.cos(a["psa"]), 0.4 * np.sin(a["psa"])))
    bench.transfer.append(lambda e: e - 3e-6 * e**2)
    bench.light.append(dark_margin)
    data, _, _ = read(bench_file(bench, air=False), configs)
    assert not data.told_of_noise


def test_a_bright_rim_of_few_pixels_is_no_offset_of_columns():
    """The mean of a column of two pixels has half of their noise, and they have most of all light."""
    random, side, states = np.random.default_rng(5), 36, 24
    inside = np.ones((side, side), dtype=bool)
    inside[:16, :6], inside[18:, :6] = False, False
    light = np.where(inside, np.where(np.arange(side) < 6, 5.0, 0.5), np.nan) * np.ones((states, 1, 1))
    r = np.sqrt(light) * random.standard_normal(light.shape)
    excess = compare_scatter(r, light, 0.01 * light, 1.0)
    assert excess.rows == excess.columns == 0
    excess = compare_scatter(r + 0.3 * random.standard_normal((states, 1, side)), light, 0.01 * light, 1.0)
    assert excess.columns == pytest.approx(0.09 / 0.5, rel=0.3)
    assert excess.rows == 0


def test_a_correlation_of_neighbours_is_as_uncertain_as_bright_pixels_are_few():
    """And as many of them have no usable neighbour at one of the distances that are compared."""
    random = np.random.default_rng(6)
    light = np.where(random.random((1, 36, 36)) < 0.05, 30.0, 0.3) * np.ones((24, 1, 1))
    light[:, random.random((36, 36)) < 0.5] = np.nan
    found = [
        compare_scatter(np.sqrt(light) * random.standard_normal(light.shape), light, 0.01 * light, 1.0)
        for _ in range(80)
    ]
    scatter = max(np.std([f.right for f in found]), np.std([f.down for f in found]))
    assert np.mean([f.alike_error for f in found]) == pytest.approx(scatter, rel=0.3)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_noise_of_few_bright_pixels_beside_dark_ones_is_no_structure(seed):
    """A bright stripe on a sixth of the image has most of the noise, which its pixels share by chance alone."""
    random, states, side = np.random.default_rng(seed), 64, 27
    light = np.where(np.arange(side) // 4 == 3, 0.5, 0.005)
    rows = random.normal(size=(states, 4)) + 2
    slope, floor = 1e-5, 1e-4
    clean = np.broadcast_to(light * (rows / rows.mean()).mean(axis=1)[:, None, None], (states, side, side))
    noise = np.sqrt(slope * clean + floor**2) * random.normal(size=clean.shape)
    noise_found = detector_noise(steady_capture(clean + noise, floor, slope), rows)
    assert abs(noise_found.white - 1) < 4 * noise_found.white_error


def test_a_small_bend_of_the_response_is_no_structure(bench_file, configs):
    """Corrected counts of a bent response scatter as their slope says."""
    model = InstrumentModel.load(configs / OPTICS).at(662)
    with Capture(bench_file(spoiled("nothing", 3, electrons=400.0), air=False)) as capture:
        data = read_capture(capture, model)
    problem = InstrumentProblem(model, [data])
    effect = instrument_effects()["tone_curve"]
    space = Space((Candidate(effect, "", effect.parameters(model, data.conditions, "")),))
    tests = []
    for bend in (0.0, 0.25):
        values = bend * space.joined("typical")
        tests.append(compute_residual(problem, 0, space, Fit(values, problem.sums(space, values), 0.0)).tests)
    assert tests[1]["sum of squares"] == pytest.approx(tests[0]["sum of squares"], abs=1.0)


def test_few_bright_pixels_do_not_tell_the_noise(configs, tmp_path):
    """Of a disc in a mosaic 40 super-pixels are far enough from the edge, and 90 of the dark background."""
    file = configs / "instruments/mosaic_polarimeter.yaml"
    model = InstrumentModel.load(file).at(662)
    bench = declared_bench(model, 662.0, 46, mosaic=True, electrons=16_000.0)
    y, x = np.mgrid[:46, :46] - 22.5
    disc = gaussian_filter(np.where(np.hypot(x, y) < 16, 1.0, 0.01), 0.6)
    bench.light.append(lambda k, electrons: electrons * disc)
    path = bench_capture(tmp_path, file, bench, states=16, seed=6, report_angles=lambda a: {"psg": a["psg"]})
    with Capture(path) as capture:
        assert screen_capture(read_capture(capture, model), model, lambda line: None).told_of_noise == ()
