"""Sums over pixels, parts and states: each shortcut says what all of them at once say."""

from dataclasses import replace

import numpy as np
import pytest
from steady_capture import steady_capture

from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.instrument import pixel_sums
from processing.diagnosis.instrument.features import FEATURES, derivatives_of_part
from processing.diagnosis.instrument.moments import moments_of
from processing.diagnosis.instrument.projection import Projected, add_blocks
from processing.diagnosis.instrument.tiles import TileSlopes, add_tiles
from processing.diagnosis.search.space import Sums
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
        add_blocks([block], a / moments.sigma[:, None], c, np.zeros((0, *a.shape)), dc=None, moments=moments, out=sums)
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
    monkeypatch.setattr(pixel_sums, "ENOUGH_PX", 1000)
    monkeypatch.setattr(pixel_sums, "LEAST_NOISE", 0.0)
    monkeypatch.setattr(pixel_sums, "STRIP_PX", 20 * COLUMNS)
    _, single = excess(*capture)
    assert np.all(np.abs(double.excess) < 6 * np.sqrt(2 * double.freedom))
    assert single.freedom == pytest.approx(double.freedom, rel=1e-6)
    assert np.all(np.abs(single.excess - double.excess) < rounding(double))


def test_without_turning_the_rows_single_precision_would_not_do(capture, monkeypatch):
    _, double = excess(*capture)
    monkeypatch.setattr(pixel_sums, "ENOUGH_PX", 1000)
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
def test_squares_are_averaged_while_they_are_read(configs, rgb950, tmp_path, monkeypatch, side):
    bench, random = TrueBench(rows=31, columns=33), np.random.default_rng(2)
    angles = state_angles(20, False, False)
    counts = digitize(bench, expose(bench, TrueScene(random), angles), random)
    counts[4, 8:9, 11:12] = 2**16 - 1
    text = (configs / "instruments/rgb950.yaml").read_text()
    write_capture(tmp_path / "c.h5", bench, counts, angles, sample=Sample(kind="unknown"), instrument=text)
    monkeypatch.setattr("processing.diagnosis.captures.read_capture.MOST_READ", counts.size / (side - 0.5) ** 2)
    with Capture(tmp_path / "c.h5") as capture:
        data = read_capture(capture, rgb950)
    assert (data.binned, data.pitch) == (side, side)
    h, w = 31 // side, 33 // side
    squares = counts[:, : h * side, : w * side].reshape(20, h, side, w, side).astype(float) - 100
    assert data.signal[:, 0] * data.conditions.full_scale == pytest.approx(squares.mean(axis=(2, 4)), rel=1e-5)
    assert np.argwhere(data.clipped).tolist() == [[8 // side, 11 // side]]
    assert np.flatnonzero(data.clipped_states).tolist() == [4]
    assert data.floor[0] * data.conditions.full_scale**2 * side**2 == pytest.approx((3.0 / 0.5) ** 2 + 1 / 12, rel=0.02)


PART_FEATURES, PART_ROWS, PART_COLUMNS = 5, 7, 3


@pytest.mark.parametrize("derivatives", [0, 2])
def test_noise_reaches_the_residual_through_the_fitted_image_where_a_feature_is_a_derivative(derivatives):
    random = np.random.default_rng(2)
    around = np.arange(PART_FEATURES) >= PART_FEATURES - derivatives
    root = random.normal(size=(PART_ROWS, PART_FEATURES, PART_FEATURES))
    noise, a = root @ root.transpose(0, 2, 1), random.normal(size=(PART_ROWS, PART_COLUMNS))
    z, c = random.normal(size=(PART_FEATURES, PART_ROWS, 4)), random.normal(size=(PART_FEATURES, PART_ROWS))
    part = Projected(z[None], noise[None], a[None], c[None], around=around)

    hat = a @ np.linalg.pinv(a)
    outside = np.eye(PART_ROWS) - hat
    # (rows of the counts, features, rows of the noise)
    onto = np.stack([c[f][:, None] * (hat if around[f] else np.eye(PART_ROWS)) for f in range(PART_FEATURES)], axis=1)
    onto_residual = np.einsum("ij,jfl->ifl", outside, onto)
    mean = np.einsum("igl,lfg->ifl", onto_residual, noise)
    assert part.expected[0] == pytest.approx(np.sum(onto_residual * mean))

    da, dc = random.normal(size=(2, 1, PART_ROWS, PART_COLUMNS)), random.normal(size=(2, 1, PART_FEATURES, PART_ROWS))
    moved = [
        np.stack(
            [dc[j, 0, f][:, None] * (hat if around[f] else np.eye(PART_ROWS)) for f in range(PART_FEATURES)], axis=1
        )
        - np.einsum("ij,jfl->ifl", da[j, 0] @ np.linalg.pinv(a), onto)
        for j in range(2)
    ]
    _, pull, _ = part.slopes(da, dc)
    assert pull == pytest.approx([np.sum(mean * each) for each in moved])


CHANNELS, FREE_STATES, VALUES = 3, 6, 4


@pytest.mark.parametrize("cut_off", [(), (7,), (3, 4, 5)])
def test_states_apart_are_what_a_column_for_each_of_them_says(cut_off):
    random = np.random.default_rng(5)
    rows, sizes = CHANNELS * FREE_STATES, ("excess", "freedom", "square", "count", "gradient", "stretch", "curvature")
    data = steady_capture(random.uniform(0.2, 0.8, (rows, 9, 9)), 1e-2)
    moments = moments_of(data, 1)
    block = replace(moments.blocks[0], rows=np.setdiff1d(np.arange(rows), cut_off))
    a, da = random.normal(size=(rows, 1)), random.normal(size=(VALUES, rows, 1))
    c, dc = np.zeros((len(FEATURES), rows)), np.zeros((VALUES, len(FEATURES), rows))
    c[0], c[FEATURES.index("square")] = 1.0, random.normal(0, 0.02, rows)
    c[FEATURES.index("dx")], dc[1, FEATURES.index("dy")] = random.normal(0, 0.1, rows), random.normal(size=rows)
    dc[2, FEATURES.index("one")] = random.normal(size=rows)
    dc[3, FEATURES.index("square")] = random.normal(size=rows)
    of_state = np.arange(rows)[:, None] // CHANNELS == np.arange(FREE_STATES)
    together, apart = Sums.empty(1, VALUES), Sums.empty(1, VALUES)
    add_blocks(
        [block], np.where(of_state, a, 0.0), c, np.where(of_state, da, 0.0), dc=dc, moments=moments, out=together
    )
    add_blocks([block], a, c, da, dc=dc, moments=moments, out=apart, apart=CHANNELS)
    for name in sizes:
        expected = getattr(together, name)
        assert getattr(apart, name) == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max()), name


def test_states_apart_in_tiles_are_what_a_column_for_each_of_them_says():
    random = np.random.default_rng(6)
    rows, sizes = CHANNELS * FREE_STATES, ("excess", "freedom", "square", "count", "gradient", "stretch", "curvature")
    data = steady_capture(random.uniform(0.2, 0.8, (rows, 32, 32)), 1e-2)
    moments = moments_of(data, 2)
    count = moments.tiles.x.size
    a, at_nodes = random.normal(size=(count, rows, 1)), random.normal(size=(VALUES, 3, rows, 1))
    c, dc = np.zeros((len(FEATURES), rows)), np.zeros((1, len(FEATURES), rows))
    c[0], dc[0, FEATURES.index("square")] = 1.0, random.normal(size=rows)
    of_state = np.arange(rows)[:, None] // CHANNELS == np.arange(FREE_STATES)
    shares, sums = random.normal(size=(3, count)), []
    for wide in (True, False):
        presence = of_state if wide else np.ones((rows, 1))
        slopes = TileSlopes(
            at_nodes=at_nodes * presence,
            shares=shares,
            fields=np.array([1]),
            da=(0.1 * np.ones((1, count, rows, 1))) * presence,
            counted=np.array([2]),
            dc=dc,
        )
        out = Sums.empty(2, VALUES)
        add_tiles(
            data, moments, moments.tiles, a * presence, c=c, slopes=slopes, out=out, apart=None if wide else CHANNELS
        )
        sums.append(out)
    for name in sizes:
        expected = getattr(sums[0], name)
        assert getattr(sums[1], name) == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max()), name
