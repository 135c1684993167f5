"""Tiles of the image whose retarders are not alike."""

from collections import defaultdict

import numpy as np
import pytest

from processing.capture import Capture
from processing.capture_schema import Sample
from processing.changes import Changes
from processing.diagnosis.capture_data import read_capture
from processing.diagnosis.moments import FOLDS_OF_TILES, moments_of
from processing.diagnosis.tile_sums import tile_columns
from processing.effects.field_retardance import terms
from processing.instrument import InstrumentModel
from simulators.blind_suite import state_angles
from simulators.undeclared import Bench, Scene, digitize, expose, write_capture


@pytest.fixture(scope="module")
def seen(configs, tmp_path_factory):
    path = tmp_path_factory.mktemp("tiles") / "capture.h5"
    bench, random = Bench(rows=32, columns=32), np.random.default_rng(3)
    angles = state_angles(40, False, False)
    counts = digitize(bench, expose(bench, Scene(random), angles), random)
    text = (configs / "instruments/rgb950.yaml").read_text()
    write_capture(path, bench, counts, angles, Sample(kind="unknown"), text)
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662)
    with Capture(path) as capture:
        data = read_capture(capture, model)
    return model, data, moments_of(data, FOLDS_OF_TILES)


@pytest.mark.parametrize("elements", [("psg_retarder",), ("psg_retarder", "psa_retarder")])
def test_columns_of_every_tile_are_those_of_its_own_retardance(seen, elements):
    model, data, moments = seen
    random = np.random.default_rng(8)
    changes = Changes(data.conditions)
    changes.stray = 0.01
    changes.retardance_rad["psg_retarder"] = random.normal(0, 0.1, data.conditions.states)
    for element in elements:
        changes.field_retardance_rad[element] = random.normal(0, 0.3, 5)
    found = tile_columns(model, data, moments, changes)
    smooth = terms(moments.tiles.x, moments.tiles.y)
    for tile in (0, 37, 255):
        here = Changes(data.conditions, stray=0.01)
        here.retardance_rad = defaultdict(lambda: np.zeros(()), changes.retardance_rad)
        for element in elements:
            extra = changes.field_retardance_rad[element] @ smooth[:, tile]
            here.retardance_rad[element] = here.retardance_rad[element] + extra
        rows = model.rows(data.conditions.angles_deg, here).reshape(-1, 16)
        assert found[tile] == pytest.approx(rows / moments.sigma[:, None], abs=1e-12 / moments.sigma.min())
