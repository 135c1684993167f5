"""A detector that bends compresses its noise too: evidence is weighed in the noise that the light has."""

from pathlib import Path

import numpy as np
import pytest
from bench_capture import bench_capture

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument.features import features
from processing.instrument.model import InstrumentModel
from simulators.blind.real_bench import RoundSample
from simulators.blind.undeclared_captures import declared_bench

STATES, PIXELS, NM = 40, 64, 662.0
BEND = 0.03


@pytest.mark.long
def test_a_bend_beside_other_faults_is_not_taken_for_several(configs: Path, tmp_path: Path) -> None:
    """A variance of the counts that is 2 % off, of 100 000 values, is more than most causes explain."""
    file = configs / "instruments/rgb950.yaml"
    bench = declared_bench(InstrumentModel.load(file).at(NM), NM, PIXELS, False, electrons=20_000.0)
    bench.transfer.append(lambda electrons: electrons * (1 - BEND * electrons / bench.full_well))
    bench.da += np.deg2rad(1.2)
    bench.path = (np.deg2rad(0.3), np.deg2rad(-0.4))
    bench.fast_slow_g = (1.0, 0.995)
    bench.level.append(lambda k, angles: 1 - 0.004 * k / STATES)
    path = bench_capture(tmp_path, file, bench, seed=2, scene=RoundSample)
    diagnosis = diagnose_captures([path], InstrumentModel.load(file))[0].diagnosis
    effects = {effect.kind: effect for effect in diagnosis.effects}
    assert set(effects) == {"detector_nonlinearity", "retarder_diattenuation", "source_drift"}
    assert effects["retarder_diattenuation"].answer == effects["source_drift"].answer == "sure"
    # A tone curve of its own size can do as well; which of the two it is one picture of a sphere need not tell.
    bend = effects["detector_nonlinearity"]
    assert bend.confident
    assert set(bend.indistinguishable_from) <= {"tone_curve"}
    lost = bend.parameters["lost_at_full_scale"]
    assert lost.value == pytest.approx(BEND, abs=4 * lost.stderr)


def test_the_slope_of_a_feature_is_its_derivative_at_dark_signals_too() -> None:
    """What noise adds to a feature is subtracted by these slopes; half of the counts of a dark pixel are negative."""
    u = np.array([-1.3e-2, -2e-4, 0.0, 3e-4, 9.5e-4, 1.2e-3, 0.04, 0.7])
    step = 1e-8
    place = np.linspace(-1, 1, len(u)), np.linspace(0.5, -1, len(u))
    _, slope = features(u, *place)
    exact = (features(u + step, *place)[0] - features(u - step, *place)[0]) / (2 * step)
    np.testing.assert_allclose(slope, exact, rtol=1e-5, atol=1e-5)
