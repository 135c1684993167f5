"""What light an image is made of: photons that scatter, and edges that move."""

from dataclasses import replace

import numpy as np
import pytest
from bench_capture import bench_capture, read

from processing.diagnosis.captures.screening import without_steep_pixels
from processing.diagnosis.instrument.noise_of_light import scatter_prefers
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.fit import Fit, Solution, held_out, minimize, prior
from processing.diagnosis.search.rules import NEEDED
from processing.diagnosis.search.space import Space
from processing.diagnosis.verdict.answer import checks
from processing.storage.captures.capture import CaptureError
from simulators.blind.undeclared_captures import TrueBench

SIDE = 24


def captured(folder, configs, bench):
    """An air capture as `diagnose` reads it."""
    file = configs / "instruments/rgb950.yaml"
    return read(bench_capture(folder, file, bench, air=True, seed=4), file)


@pytest.mark.parametrize("leaks", [True, False])
def test_light_that_leaks_scatters_and_an_offset_does_not(configs, tmp_path, leaks):
    bench = TrueBench(rows=SIDE, columns=SIDE, electrons=600.0)
    if leaks:
        bench.extinction_a = 0.1
    else:
        bench.stored.append(lambda counts: counts + 80)
    model, data = captured(tmp_path, configs, bench)
    problem = InstrumentProblem(model, [data], folds=1)
    offset, leak = (next(c for c in problem.pool() if c.kind == kind) for kind in ("detector_offset", "psa_extinction"))
    # Either describes the counts: what is left is noise. The scatter knows which it is.
    cause, value = (leak, np.array([0.1])) if leaks else (offset, np.array([80.0]))
    gain = scatter_prefers(problem, Space((cause,)), value, {offset: np.array([80.0])})
    assert gain < -NEEDED if leaks else gain > NEEDED


@pytest.mark.parametrize("size", [-0.05, 0.05])
def test_counts_scatter_as_the_bend_says_that_made_them(configs, tmp_path, size):
    """A bend stretches the photon noise with the counts, whether it compresses them or not."""
    bench = TrueBench(rows=2 * SIDE, columns=2 * SIDE, electrons=9000.0)
    bench.transfer.append(lambda electrons: electrons * (1 - size * electrons / 10_000))
    model, data = captured(tmp_path, configs, bench)
    problem = InstrumentProblem(model, [data], folds=1)
    bend = next(c for c in problem.pool() if c.kind == "detector_nonlinearity")
    full_scale = data.conditions.full_scale * bench.gain
    value = np.array([size * full_scale / 10_000])
    assert scatter_prefers(problem, Space((bend,)), value, {bend: value}) > NEEDED


def test_what_a_fit_leaves_of_the_optics_is_no_noise(configs, tmp_path):
    bench = TrueBench(rows=SIDE, columns=SIDE, electrons=6000.0)
    bench.dg += np.deg2rad(15)
    model, data = captured(tmp_path, configs, bench)
    problem = InstrumentProblem(model, [data], folds=1)
    offset = next(c for c in problem.pool() if c.kind == "detector_offset")
    # The plate is not in the fit, so much is left over. More light below black would scatter more, but nothing does.
    assert scatter_prefers(problem, Space(()), np.zeros(0), {offset: np.array([-400.0])}) < -NEEDED


@pytest.mark.parametrize("stated", [True, False])
def test_noise_follows_the_light_unless_it_is_stated(configs, tmp_path, stated):
    bench = TrueBench(rows=SIDE, columns=SIDE, electrons=6000.0)
    bench.stored.append(lambda counts: counts + 400)
    model, data = captured(tmp_path, configs, bench)
    if stated:
        data = replace(data, slope=np.zeros_like(data.slope), noise_source="stated per state")
    problem = InstrumentProblem(model, [data], folds=1)
    offset = next(c for c in problem.pool() if c.kind == "detector_offset")
    assert problem.adopt_noise(Space((offset,)), np.array([400.0])) is not stated


def test_the_noise_of_light_that_does_not_scatter_so_is_not_taken(configs, tmp_path):
    model, data = captured(tmp_path, configs, TrueBench(rows=SIDE, columns=SIDE, electrons=6000.0))
    problem = InstrumentProblem(model, [data], folds=1)
    bend = next(c for c in problem.pool() if c.kind == "detector_nonlinearity")
    before = problem.moments[0].sigma
    assert not problem.adopt_noise(Space((bend,)), np.array([0.2]))
    assert np.array_equal(problem.moments[0].sigma, before)


def test_pixels_at_an_edge_are_left_out_and_those_of_a_slope_are_not(configs, tmp_path):
    _, data = captured(tmp_path, configs, TrueBench(rows=SIDE, columns=SIDE))

    def left(image):
        return without_steep_pixels(replace(data, signal=np.broadcast_to(image, data.signal.shape).astype(np.float32)))

    across = np.broadcast_to(np.linspace(0.3, 0.6, SIDE), (SIDE, SIDE))
    assert left(across).usable.sum() == data.usable.sum()
    cut = left(np.where(np.arange(SIDE) < 8, 0.1, across))
    assert not cut.usable[:, 4:12].any()
    assert cut.usable[:, 14:].all()
    assert np.array_equal(cut.steep, ~cut.usable)
    # A small object before a dark wall: its inside, steep as it is, moves as it should.
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    hill = 0.01 + np.exp(-(x**2 + y**2) / (SIDE / 3) ** 2)
    ball = left(np.where(np.hypot(x, y) < SIDE / 3, hill, 0.01)).usable
    assert ball[np.hypot(x, y) < 2].all()
    assert not ball[np.abs(np.hypot(x, y) - SIDE / 3) < 2].any()
    # All edges: there is nothing else to look at than the flattest quarter.
    stripes = 0.2 + 0.4 * np.arange(SIDE) / SIDE * (np.arange(SIDE) % 2)
    assert left(stripes).usable.mean() == pytest.approx(0.25, abs=0.05)


def test_pixels_at_the_rim_alone_are_an_error_in_words(configs, tmp_path):
    model, data = captured(tmp_path, configs, TrueBench(rows=SIDE, columns=SIDE))
    rim = np.ones((SIDE, SIDE), dtype=bool)
    rim[2:-2, 2:-2] = False
    with pytest.raises(CaptureError, match="no pixel is at once bright"):
        InstrumentProblem(model, [replace(data, usable=rim)])


@pytest.mark.parametrize("bend", [-0.1, 0.1])
def test_a_bend_that_held_out_data_do_not_have_changes_no_residual(bend, configs, tmp_path):
    """Fits to a half of the image undo another bend than the fit to all, which stretches noise and residual alike."""
    model, data = captured(tmp_path, configs, TrueBench(rows=SIDE, columns=SIDE, electrons=6000.0))
    problem = InstrumentProblem(model, [data], folds=2)
    base, space = Space(()), Space(tuple(c for c in problem.pool() if c.kind == "detector_nonlinearity"))
    straight = minimize(problem, base, np.zeros(0))
    before = held_out(problem, base, straight)
    problem.relinearize(space, np.array([bend]))
    sums = problem.sums(space, np.array([bend]))
    bent = Fit(np.array([bend]), sums, float(sums.excess.sum()))
    solved = Solution(base, straight, before, space, bent, held_out(problem, space, bent), prior(space))
    residual = checks(problem, solved)[0]
    assert residual.holds
    assert residual.after == pytest.approx(residual.before, rel=2e-3)
