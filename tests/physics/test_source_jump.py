"""A capture that was gone on with: the source may stand at another level in each run."""

import numpy as np
import pytest
from bench_capture import bench_capture

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from simulators.blind.undeclared_captures import TrueBench

STATES, RESUMED = 40, 22


@pytest.mark.parametrize("air", [True, False])
@pytest.mark.parametrize("fraction", [-0.04, 0.0])
def test_a_jump_between_two_runs_is_found_and_none_where_there_is_none(configs, tmp_path, monkeypatch, air, fraction):
    bench, file = TrueBench(rows=16, columns=16), configs / "instruments/rgb950.yaml"
    bench.level.append(lambda k, a: 1 + fraction * (k >= RESUMED))
    path = bench_capture(tmp_path, file, bench, air, STATES, seed=11)
    with Capture(path) as capture:
        resumed = (np.arange(len(capture.done)) >= len(capture.done) - STATES + RESUMED).astype(np.int64)
    monkeypatch.setattr(Capture, "run_of_states", resumed)
    diagnosis = diagnose_captures([path], InstrumentModel.load(file))[0].diagnosis
    if fraction:
        assert diagnosis.verdict == "explained"
        assert [e.kind for e in diagnosis.effects if e.confident] == ["source_jump"]
        jump = diagnosis.effects[0].parameters["run_2"]
        assert jump.value == pytest.approx(fraction, abs=4 * jump.stderr)
        assert jump.stderr < 0.002
    else:
        assert not diagnosis.effects
