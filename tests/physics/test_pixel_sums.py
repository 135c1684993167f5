"""Sums over pixels: strips and single precision say what all pixels at once say in double."""

import numpy as np
import pytest
from steady_capture import steady_capture

from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.instrument import pixel_sums
from processing.diagnosis.instrument.features import FEATURES, derivatives_of_part
from processing.diagnosis.instrument.moments import moments_of
from processing.diagnosis.instrument.projection import add_block
from processing.diagnosis.search.space import Sums
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import Sample
from simulators.blind.undeclared_captures import TrueBench, TrueScene, digitize, expose, state_angles, write_capture

STATES, ROWS, COLUMNS, NOISE = 12, 90, 70, 1e-3


@pytest.fixture(scope="module")
def capture():
    """Three patterns, the brightest a thousand times the noise."""
    random = np.random.default_rng(6)
    y, x = np.mgrid[0:ROWS, 0:COLUMNS] / ROWS
    patterns = np.stack([0.5 + 0.3 * np.sin(3 * x), 0.1 * np.cos(4 * y), 0.05 * x * y])
    a = np.column_stack([np.ones(STATES), random.normal(size=(STATES, 2))])
    signal = np.tensordot(a, patterns, 1) + NOISE * random.normal(size=(STATES, ROWS, COLUMNS))
    data = steady_capture(signal, NOISE)
    return a, data


def excess(a, data):
    moments = moments_of(data, 2)
    c = np.zeros((len(FEATURES), STATES))
    c[0], c[FEATURES.index("square")], c[FEATURES.index("dx")] = 1.0, 1e-4, 1e-3
    sums = Sums.empty(2, 0)
    for block in moments.blocks:
        add_block(block, a / moments.sigma[:, None], c, np.zeros((0, *a.shape)), dc=None, moments=moments, out=sums)
    return moments, sums


def rounding(sums):
    """What single precision can change in a sum of squares (F,), in whatever order a processor adds.

    A sum of n products is off by at most n u / (1 - n u) of the sum of their sizes, u = 2^-24 (Higham, Accuracy and
    Stability of Numerical Algorithms, 2002, section 3.1). So many are added before they go on in double.
    """
    n = min(pixel_sums.TOGETHER, 20 * COLUMNS)
    off = n * np.finfo(np.float32).eps / 2
    return off / (1 - off) * (sums.freedom + sums.excess)


@pytest.mark.parametrize("threads", ["1", "2"])
def test_single_precision_in_strips_is_what_double_says(capture, monkeypatch, threads):
    _, double = excess(*capture)
    monkeypatch.setenv("UMOV_THREADS", threads)
    monkeypatch.setattr(pixel_sums, "MANY_PX", 0)
    monkeypatch.setattr(pixel_sums, "NOISE_OF_SINGLE", 0.0)
    monkeypatch.setattr(pixel_sums, "STRIP_PX", 20 * COLUMNS)
    _, single = excess(*capture)
    assert np.all(np.abs(double.excess) < 6 * np.sqrt(2 * double.freedom))
    assert single.freedom == pytest.approx(double.freedom, rel=1e-6)
    assert np.all(np.abs(single.excess - double.excess) < rounding(double))


def test_without_turning_the_rows_single_precision_would_not_do(capture, monkeypatch):
    _, double = excess(*capture)
    monkeypatch.setattr(pixel_sums, "MANY_PX", 0)
    monkeypatch.setattr(pixel_sums.Pixels, "basis", np.eye(STATES))
    _, single = excess(*capture)
    assert np.all(np.abs(single.excess - double.excess) > 100 * rounding(double))


def test_derivatives_of_a_part_are_those_of_the_image(capture):
    images = capture[1].signal[:2, 0]
    of_image = derivatives_of_part(images, *(slice(0, n) for n in images.shape[1:]))
    for rows, columns in ((slice(20, 31), slice(40, 52)), (slice(3, 9), slice(3, COLUMNS - 3))):
        part = derivatives_of_part(images, rows, columns)
        assert part == pytest.approx(of_image[:, :, rows, columns], abs=1e-7)


@pytest.mark.parametrize("side", [1, 2, 3])
def test_squares_are_averaged_while_they_are_read(configs, tmp_path, monkeypatch, side):
    bench, random = TrueBench(rows=31, columns=33), np.random.default_rng(2)
    angles = state_angles(20, False, False)
    counts = digitize(bench, expose(bench, TrueScene(random), angles), random)
    counts[4, 8:9, 11:12] = 2**16 - 1
    text = (configs / "instruments/rgb950.yaml").read_text()
    write_capture(tmp_path / "c.h5", bench, counts, angles, sample=Sample(kind="unknown"), instrument=text)
    monkeypatch.setattr("processing.diagnosis.captures.read_capture.MOST_READ", counts.size / (side - 0.5) ** 2)
    with Capture(tmp_path / "c.h5") as capture:
        data = read_capture(capture, InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662))
    assert (data.binned, data.pitch) == (side, side)
    h, w = 31 // side, 33 // side
    squares = counts[:, : h * side, : w * side].reshape(20, h, side, w, side).astype(float) - 100
    assert data.signal[:, 0] * data.conditions.full_scale == pytest.approx(squares.mean(axis=(2, 4)), rel=1e-5)
    assert np.argwhere(data.clipped).tolist() == [[8 // side, 11 // side]]
    assert np.flatnonzero(data.clipped_states).tolist() == [4]
    assert data.floor[0] * data.conditions.full_scale**2 * side**2 == pytest.approx((3.0 / 0.5) ** 2 + 1 / 12, rel=0.02)
