"""Two nominal files, plates 40 to 260 degrees apart: the same M, the same signs, the same standard errors."""

import numpy as np
import pytest

from benchmarks.instrument_chain import means_of, relative
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument_file import write_instrument
from processing.instrument.model import InstrumentModel
from processing.steps.reduction import Reduction
from processing.yaml_file import dump_yaml
from simulators.blind.emulated_instruments import BENCHES, INSTRUMENTS, SAMPLE, emulated_capture

PLATES = ("psg_retarder", "psa_retarder")
#: Instruments with two plates, and by how many degrees the azimuth of the second one is off.
TWO_PLATES = {"drr_wollaston": 100, "drr_5to1": 80, "drr_single_detector": 40, "drr_imaging_630nm": 260, "rgb950": 130}
#: What no capture of air can show: the sign of circular light.
OTHER_SIGN = np.diag([1.0, 1.0, 1.0, -1.0])


def turned(model, **by_deg):
    return model.with_values({p: {"azimuth_deg": model.value_of(f"{p}.azimuth_deg") + by} for p, by in by_deg.items()})


def two_starts(name, folder, plates, by_deg):
    """Diagnose one capture of air from a file near the truth and from another; reduce another sample with both.

    Returns M/m00 (2, 4, 4), its standard errors (4, 4), the largest ratio of the standard errors of a value of the
    train, and what the second report says of the sign.
    """
    bench, random = BENCHES[name], np.random.default_rng(2)
    calibrate = tuple(f"{plate}.{field}_deg" for plate in PLATES for field in ("azimuth", "retardance"))
    nominal = InstrumentModel.load(INSTRUMENTS / f"{name}.yaml").at(bench.nm)
    nominal = nominal.model_copy(update={"beams": None, "calibrate": calibrate, "belongs_to": {}})
    true = turned(nominal, psg_retarder=3.0, psa_retarder=-2.0)
    file = folder / f"{name}.yaml"
    file.write_text(dump_yaml(nominal))
    air, sample = (
        emulated_capture(true, bench, m, kind, file=file, random=random)
        for m, kind in ((np.eye(4), "air"), (SAMPLE, "unknown"))
    )
    diagnoses, products = [], []
    for by in (0.0, by_deg):
        model, new = turned(nominal, **dict.fromkeys(plates, by)), folder / f"{name}_{by:g}.yaml"
        diagnoses.append(diagnose_captures([air], model)[0].diagnosis)
        write_instrument(new, model, diagnoses[-1])
        products.append(relative(means_of(Reduction(sample, new).make(new.with_suffix(".h5"), True))))
    first, second = ({key: value.stderr for key, value in d.calibrated.items()} for d in diagnoses)
    ratios = [second[key] / first[key] for key in first]
    m = np.array([values.reshape(4, 4) for values, _ in products])
    return m, products[0][1].reshape(4, 4), max(max(r, 1 / r) for r in ratios), diagnoses[1].branch


@pytest.mark.long
@pytest.mark.parametrize(("instrument", "by_deg"), TWO_PLATES.items())
def test_the_start_decides_nothing(instrument, by_deg, tmp_path):
    (first, second), stated, ratio, branch = two_starts(instrument, tmp_path, PLATES[1:], by_deg)
    assert np.max((np.abs(second - first) / stated).ravel()[1:]) < 1
    # Row 3 and column 3 have the same sign.
    circular = [1, 2, 3, 3], [3, 3, 1, 2]
    assert first[circular] @ second[circular] > 0
    assert ratio < 1.2
    assert first == pytest.approx(SAMPLE / SAMPLE[0, 0], abs=0.02)
    assert branch is not None
    assert "The instrument file decides" in branch


@pytest.mark.long
def test_a_file_that_is_wrong_for_every_plate_decides_for_the_other_sign(tmp_path):
    (first, second), _, ratio, branch = two_starts("rgb950", tmp_path, PLATES, 100)
    assert OTHER_SIGN @ second @ OTHER_SIGN == pytest.approx(first, abs=3e-3)
    assert "row 3 and column 3 of M have the other sign" in branch
    assert ratio < 1.2
