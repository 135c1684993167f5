"""Two nominal files, one plate 100 degrees apart: the same M, the same signs, the same standard errors."""

import numpy as np
import pytest

from processing.diagnosis.instrument.run import diagnose_captures
from processing.diagnosis.instrument_file import extended
from processing.instrument.model import InstrumentModel
from processing.yaml_file import dump_yaml

#: Instruments, with angles of their axes, and what is nominal of their plates. Truth is this far from the file.
INSTRUMENTS = {
    "drr_wollaston": {"psg": 4.0 * np.arange(46)},
    "drr_5to1": {"psg": 6.0 * np.arange(61), "psa": 30.0 * np.arange(61)},
    "drr_single_detector": {"psg": 6.0 * np.arange(61), "psa": 30.0 * np.arange(61)},
    "drr_imaging_630nm": {
        "psg": np.tile(np.repeat(22.5 * np.arange(8), 8), 2),
        "psa": np.tile(22.5 * np.arange(8), 16),
        "analyzer": np.repeat([0.0, 45.0], 64),
    },
    "rgb950": {"psg": 9.0 * np.arange(40), "psa": 4.91 * 9.0 * np.arange(40)},
}
PLATES = ("psg_retarder", "psa_retarder")


@pytest.mark.parametrize("instrument", INSTRUMENTS)
def test_the_start_decides_nothing(instrument, configs, synthetic_capture):
    nm = 630.0 if instrument == "drr_imaging_630nm" else 662.0
    angles, random = INSTRUMENTS[instrument], np.random.default_rng(2)
    nominal = InstrumentModel.load(configs / f"instruments/{instrument}.yaml").at(nm)
    calibrate = tuple(f"{plate}.{field}_deg" for plate in PLATES for field in ("azimuth", "retardance"))
    nominal = nominal.model_copy(update={"beams": None, "calibrate": calibrate, "belongs_to": {}})

    def turned(model, **by):
        azimuth = {plate: {"azimuth_deg": model.value_of(f"{plate}.azimuth_deg") + a} for plate, a in by.items()}
        return model.with_values(azimuth)

    true = turned(nominal, psg_retarder=3.0, psa_retarder=-2.0)
    signal = true.rows(angles) @ np.eye(4).reshape(16) * 1e4
    signal = signal + 5.0 * random.standard_normal(signal.shape)
    names = tuple(c.name for c in nominal.channels)
    path = synthetic_capture(
        signal[..., None, None],
        angles,
        sample={"kind": "air"},
        wavelength_nm=nm,
        channels=names,
        instrument_yaml=dump_yaml(nominal),
    )
    near, far = (diagnose_captures([path], turned(nominal, psa_retarder=by))[0].diagnosis for by in (0.0, 100.0))
    for name, value in near.calibrated.items():
        assert (far.calibrated[name].value - value.value + 90) % 180 - 90 == pytest.approx(0, abs=3 * value.stderr)
        assert far.calibrated[name].stderr == pytest.approx(value.stderr, rel=0.2)
    assert near.branch is not None
    assert "The instrument file decides" in near.branch
    inverse = [np.linalg.pinv(extended(nominal, d).at(nm).rows(angles, None).reshape(-1, 16)) for d in (near, far)]
    plate = true.rows(angles).reshape(-1, 16) @ QUARTER_WAVE.reshape(16)
    first, second = (m @ plate for m in inverse)
    assert second == pytest.approx(first, abs=3e-3)
    assert first.reshape(4, 4) == pytest.approx(QUARTER_WAVE, abs=0.02)


QUARTER_WAVE = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]])
