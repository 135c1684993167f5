"""A source with a level of its own in every state: each state projected by itself says what all of them at once say."""

from dataclasses import replace

import numpy as np
import pytest
from steady_capture import steady_capture

from processing.diagnosis.instrument.features import FEATURES
from processing.diagnosis.instrument.moments import moments_of
from processing.diagnosis.instrument.projection import add_block
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
    add_block(block, np.where(of_state, a, 0.0), c, np.where(of_state, da, 0.0), dc, moments, together)
    add_block(block, a, c, da, dc, moments, apart, apart=CHANNELS)
    for name in sizes:
        expected = getattr(together, name)
        assert getattr(apart, name) == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(expected).max()), name
