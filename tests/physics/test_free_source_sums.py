"""A source with a level of its own in every state: each state projected by itself says what all of them at once say."""

from dataclasses import replace

import numpy as np
import pytest
from steady_capture import steady_capture

from processing.diagnosis.instrument.features import FEATURES
from processing.diagnosis.instrument.moments import moments_of
from processing.diagnosis.instrument.projection import add_block
from processing.diagnosis.instrument.tiles import TileSlopes, add_tiles
from processing.diagnosis.search.space import Sums

CHANNELS, STATES, VALUES = 3, 6, 4


@pytest.mark.parametrize("cut_off", [(), (7,), (3, 4, 5)])
def test_states_apart_are_what_a_column_for_each_of_them_says(cut_off):
    random = np.random.default_rng(5)
    rows, sizes = CHANNELS * STATES, ("excess", "freedom", "square", "count", "gradient", "stretch", "curvature")
    data = steady_capture(random.uniform(0.2, 0.8, (rows, 9, 9)), 1e-2)
    moments = moments_of(data, 1)
    block = replace(moments.blocks[0], rows=np.setdiff1d(np.arange(rows), cut_off))
    a, da = random.normal(size=(rows, 1)), random.normal(size=(VALUES, rows, 1))
    c, dc = np.zeros((len(FEATURES), rows)), np.zeros((VALUES, len(FEATURES), rows))
    c[0], c[FEATURES.index("square")] = 1.0, random.normal(0, 0.02, rows)
    c[FEATURES.index("dx")], dc[1, FEATURES.index("dy")] = random.normal(0, 0.1, rows), random.normal(size=rows)
    dc[2, FEATURES.index("one")] = random.normal(size=rows)
    dc[3, FEATURES.index("square")] = random.normal(size=rows)
    of_state = np.arange(rows)[:, None] // CHANNELS == np.arange(STATES)
    together, apart = Sums.empty(1, VALUES), Sums.empty(1, VALUES)
    add_block(block, np.where(of_state, a, 0.0), c, np.where(of_state, da, 0.0), dc=dc, moments=moments, out=together)
    add_block(block, a, c, da, dc=dc, moments=moments, out=apart, apart=CHANNELS)
    for name in sizes:
        expected = getattr(together, name)
        assert getattr(apart, name) == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max()), name


def test_states_apart_in_tiles_are_what_a_column_for_each_of_them_says():
    random = np.random.default_rng(6)
    rows, sizes = CHANNELS * STATES, ("excess", "freedom", "square", "count", "gradient", "stretch", "curvature")
    data = steady_capture(random.uniform(0.2, 0.8, (rows, 32, 32)), 1e-2)
    moments = moments_of(data, 2)
    count = moments.tiles.x.size
    a, at_nodes = random.normal(size=(count, rows, 1)), random.normal(size=(VALUES, 3, rows, 1))
    c, dc = np.zeros((len(FEATURES), rows)), np.zeros((1, len(FEATURES), rows))
    c[0], dc[0, FEATURES.index("square")] = 1.0, random.normal(size=rows)
    of_state = np.arange(rows)[:, None] // CHANNELS == np.arange(STATES)
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
