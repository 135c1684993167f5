"""Whether an effect is as large in every part of the image, where something else is not told right or moves it."""

import numpy as np
import pytest
from bench_capture import bench_capture
from scipy.ndimage import rotate

from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.captures.screening import without_steep_pixels
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.unevenness import Evenness
from processing.diagnosis.search.fit import minimize
from processing.diagnosis.search.space import Space
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from simulators.blind.real_bench import RoundSample
from simulators.blind.undeclared_captures import TrueBench

STATES = 40


def test_a_source_whose_size_is_told_too_small_is_as_even_as_one_that_is_told_right(configs, tmp_path):
    """Values that shrink to their prior leave a part of themselves in the whole image; that is no variation over it."""
    bench = TrueBench(rows=40, columns=40)
    bench.level.append(lambda k, a: 1 + 0.05 * k / (STATES - 1))
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").nominal_at(662)
    with Capture(bench_capture(tmp_path, configs / "instruments/rgb950.yaml", bench, air=True)) as capture:
        problem = InstrumentProblem(model, [read_capture(capture, model)])
    drift = next(c for c in problem.pool() if c.kind == "source_drift")
    for size in (0.05, 0.02):
        excess, terms = Evenness(problem, Space((drift,)), np.array([size, 0.0])).varies(drift)
        assert excess < 4 * np.sqrt(2 * terms)


def test_where_the_image_moves_a_source_is_as_even(configs, tmp_path):
    """A twentieth of a pixel at the limb of a ball changes more than the source does; it is undone here too."""
    bench = TrueBench(rows=64, columns=64)
    bench.level.append(lambda k, a: 1 + 0.03 * k / (STATES - 1))
    bench.shift.append(lambda k, a: (0.06 * k / (STATES - 1), 0.06 * k / (STATES - 1)))
    file = configs / "instruments/rgb950.yaml"
    path = bench_capture(tmp_path, file, bench, seed=8, scene=RoundSample)
    model = InstrumentModel.load(file).nominal_at(662)
    with Capture(path) as capture:
        problem = InstrumentProblem(model, [without_steep_pixels(read_capture(capture, model))])
    space = Space(tuple(c for c in problem.pool() if c.kind in ("source_drift", "image_drift")))
    fit = minimize(problem, space, np.zeros(space.size))
    drift = next(c for c in space.candidates if c.kind == "source_drift")
    excess, terms = Evenness(problem, space, fit.values).varies(drift)
    assert abs(excess) < 4 * np.sqrt(2 * terms)


@pytest.mark.parametrize("turns", [False, True])
def test_a_drift_is_even_over_the_image_and_an_image_that_turns_is_not(configs, tmp_path, turns):
    bench = TrueBench(rows=64, columns=64)
    bench.shift.append(lambda k, a: (0.1 * k / (STATES - 1), 0.0))
    if turns:
        bench.light.append(lambda k, e: rotate(e, 0.3 * k / (STATES - 1), reshape=False, order=3, mode="nearest"))
    file = configs / "instruments/rgb950.yaml"
    model = InstrumentModel.load(file).nominal_at(662)
    with Capture(bench_capture(tmp_path, file, bench, seed=8, scene=RoundSample)) as capture:
        problem = InstrumentProblem(model, [without_steep_pixels(read_capture(capture, model))])
    space = Space(tuple(c for c in problem.pool() if c.kind == "image_drift"))
    fit = minimize(problem, space, np.zeros(space.size))
    excess, terms = Evenness(problem, space, fit.values).varies(space.candidates[0])
    assert (excess > 4 * np.sqrt(2 * terms)) == turns, excess
