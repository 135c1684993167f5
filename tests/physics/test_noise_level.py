"""Noise as large as the pixels show it: a gain stated a little wrong, an offset that looks like read-out noise."""

from dataclasses import replace

import numpy as np
import pytest
from bench_capture import bench_capture, read

from processing.diagnosis.captures.screening import screen_capture
from processing.diagnosis.instrument.diagnose import diagnose
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.space import Space
from simulators.blind.real_bench import RoundSample
from simulators.blind.undeclared_captures import TrueBench

SIDE, STATES = 64, 40


def captured(folder, configs, bench, scene=None):
    """A capture as `diagnose` reads it: of air, or of an unknown sample."""
    file = configs / "instruments/rgb950.yaml"
    return read(bench_capture(folder, file, bench, scene is None, STATES, 11, scene=scene), file)


def said(model, *captures):
    """What `diagnose` says of captures, by kind whether a name is sure."""
    diagnosis = diagnose(InstrumentProblem(model, list(captures)), lambda line: None).diagnosis
    return diagnosis, {e.kind: e.answer for e in diagnosis.effects if e.confident}


@pytest.mark.long
@pytest.mark.parametrize("times", [0.965, 1.04])
def test_a_gain_that_is_stated_some_percent_wrong_hides_no_cause(configs, tmp_path, times):
    """Four percent of the variance of 160 000 intensities is eleven standard deviations of their sum of squares."""
    bench = TrueBench(rows=SIDE, columns=SIDE)
    bench.dg += np.deg2rad(0.4)
    bench.ellipticity = np.deg2rad(0.5)
    bench.level.append(lambda k, a: 1 + 0.01 * k / (STATES - 1))
    model, data = captured(tmp_path, configs, bench)
    diagnosis, sure = said(model, replace(data, slope=times * data.slope, floor=times * data.floor))
    assert diagnosis.verdict == "explained"
    assert {"psg_retardance", "source_drift"} <= set(sure)
    assert diagnosis.error_after.chi2_reduced == pytest.approx(1.0, abs=0.01)


@pytest.mark.long
def test_an_offset_is_no_other_read_noise(configs, tmp_path):
    """A ball before a dark wall: what is added to all counts takes photon noise along in what is expected of them."""
    bench = TrueBench(rows=SIDE, columns=SIDE, read_noise=3.0)
    bench.da += np.deg2rad(0.5)
    bench.stored.append(lambda counts: counts + 60)
    model, ball = captured(tmp_path / "ball", configs, bench, RoundSample)
    _, air = captured(tmp_path, configs, bench)
    lines = []
    ball, air = (screen_capture(d, model, lines.append) for d in (ball, air))
    assert any("variance of a pixel" in line for line in lines)
    diagnosis, sure = said(model, ball, air)
    assert diagnosis.noise.verdict == "as_declared"
    assert {"psa_retardance", "detector_offset"} <= set(sure)


def test_an_offset_that_nothing_else_shows_leaves_the_noise_of_the_light(configs, tmp_path):
    """Behind it the dark wall scatters otherwise than its counts say, and the ball as before."""
    bench = TrueBench(rows=SIDE, columns=SIDE, read_noise=3.0)
    bench.stored.append(lambda stored: stored + 60)
    model, data = captured(tmp_path, configs, bench, RoundSample)
    problem, nothing = InstrumentProblem(model, [data]), Space(())
    problem.level_noise(nothing, np.zeros(0))
    (leveled,) = problem.still
    assert leveled.slope == pytest.approx(data.slope, rel=0.015)
