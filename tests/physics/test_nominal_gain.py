"""Gains of channels that `calibrate` lists are fitted like the other nominal values, and go into the file."""

import numpy as np
import pytest

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument_file import write_instrument
from processing.instrument.model import InstrumentModel
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture
from processing.yaml_file import dump_yaml

GAINS = {"45": 0.93, "90": 1.22, "135": 0.84}


def test_four_channels_of_unequal_gain_behind_a_flickering_source(configs, tmp_path):
    """40 exposures of air in four channels: what is left is the noise of 0.1 %, and the file holds the gains."""
    random = np.random.default_rng(3)
    nominal = InstrumentModel.load(configs / "instruments/mosaic_polarimeter.yaml")
    listed = tuple(f"{name}.gain" for name in GAINS)
    nominal = nominal.model_copy(update={"mosaic": None, "calibrate": listed, "free_source": True})
    true = nominal.with_values({name: {"gain": gain} for name, gain in GAINS.items()}).at(662)
    angles = 9.0 * np.arange(40)
    signal = true.rows({"psg": angles}) @ np.eye(4).reshape(16) * 10_000
    signal = signal * random.uniform(0.9, 1.1, (40, 1)) * (1 + 1e-3 * random.standard_normal(signal.shape))
    names = ",".join(f"channel_{c.name}" for c in true.channels)
    lines = [f"state,psg_deg,{names}"]
    lines += [f"{k},{a},{','.join(map(str, row))}" for k, (a, row) in enumerate(zip(angles, signal, strict=True))]
    states, instrument = tmp_path / "air.csv", tmp_path / "four.yaml"
    states.write_text("\n".join(lines) + "\n", encoding="utf-8")
    instrument.write_text(dump_yaml(nominal), encoding="utf-8")
    air = tmp_path / "air.h5"
    import_capture(
        ImportRequest(states=states, out=air, wavelength_nm=662, instrument=instrument, sample=read_sample("air"))
    )
    diagnosis = diagnose_captures([air], nominal)[0].diagnosis
    assert diagnosis.error_after.rms_percent == pytest.approx(0.1, abs=0.03)
    write_instrument(tmp_path / "new.yaml", nominal, diagnosis)
    written = InstrumentModel.load(tmp_path / "new.yaml").at(662)
    for name, gain in GAINS.items():
        assert written.value_of(f"{name}.gain") == pytest.approx(gain, abs=0.002)
