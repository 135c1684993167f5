"""Diagnose a capture of air, write the file, reduce another sample: its M is better than before, or unchanged."""

import numpy as np
import pytest

from benchmarks import instrument_chain as chain
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.instrument.model import InstrumentModel
from processing.yaml_file import dump_yaml
from simulators.blind.emulated_instruments import BENCHES, OF_AIR, Bench, emulated_capture


def test_every_instrument_has_its_line(configs):
    assert set(BENCHES) == {path.stem for path in (configs / "instruments").glob("*.yaml")}


#: An instrument of each kind: two plates, mosaic, part of a matrix. The others are `long`.
KINDS = {"rgb950", "mosaic_polarimeter", "rotating_retarder_stokes"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (name not in KINDS)) for name in BENCHES]
)
def test_the_next_sample_is_measured_better_or_as_before(name, tmp_path):
    row = chain.emulated(name, tmp_path)
    assert row.written <= 1.01 * min(row.nominal, row.train)
    # Three standard errors of noise and of what the diagnosis left uncertain.
    assert row.written < 3 * row.stated


@pytest.mark.long
@pytest.mark.measured
def test_a_measured_mirror_is_one(tmp_path):
    row = chain.mirror_frames(tmp_path)
    assert row.written <= 1.01 * min(row.nominal, row.train)
    assert row.written < 3 * row.stated


@pytest.mark.long
@pytest.mark.measured
@pytest.mark.parametrize("nm", chain.MEASURED_NM)
def test_a_measured_plate_is_nearer_to_the_ratio_of_its_channels(nm, public_files, tmp_path):
    row = chain.half_wave_plate(nm, public_files("drr-wollaston-nir"), tmp_path)
    assert row.written <= 1.01 * min(row.nominal, row.train)
    # At 1950 nm the ratio itself needs elliptical light, and 0.3 % of it is left.
    assert row.written < (0.005 if nm < 1900 else 0.02)


@pytest.mark.long
@pytest.mark.measured
def test_a_plate_of_fewer_states_of_air_is_nearer_too(public_files, tmp_path):
    """At 1300 nm no cause is left: the gain of the right beam is a value of the train, as no two beams are alike."""
    row = chain.half_wave_plate(1300, public_files("drr-wollaston-nir"), tmp_path, draw=1)
    assert row.verdict == "consistent"
    assert row.written <= row.train < 0.0015


@pytest.mark.parametrize("fault", ["slips", pytest.param("angles", marks=pytest.mark.long)])
def test_a_fault_of_the_air_capture_alone_stays_there(fault, tmp_path):
    row = chain.emulated("rgb950", tmp_path, 2, OF_AIR[fault])
    assert row.written < 0.5 * row.nominal


@pytest.mark.long
def test_a_source_that_wanders_in_air_alone_stays_there(tmp_path):
    """One pixel, an unknown noise and structure: one draw says little, so three are averaged."""
    rows = []
    for seed in (2, 3, 4):
        (folder := tmp_path / str(seed)).mkdir()
        rows.append(chain.emulated("rgb950", folder, seed, OF_AIR["source"]))
    assert all(row.written < row.nominal for row in rows)
    # Less than a chain left that kept the noise of the likeliest set: 0.63, 0.81 and 0.75.
    assert np.mean([row.written / row.nominal for row in rows]) < 0.6


@pytest.mark.parametrize(("gains", "is_nominal"), [((1.03, 1.0), False), ((1.05, 1.02), True)])
def test_the_noise_of_a_dark_channel_is_no_tone_curve(gains, is_nominal, configs, tmp_path):
    """A polarization camera sees horizontal light: one channel is dark, and the gains of two others are off."""
    names = ("45", "135")
    stated = InstrumentModel.load(configs / "instruments/linear_stokes.yaml").at(662)
    stated = stated.model_copy(update={"calibrate": tuple(f"{n}.gain" for n in names) if is_nominal else ()})
    true = stated.with_values({name: {"gain": gain} for name, gain in zip(names, gains, strict=True)})
    file = tmp_path / "stokes.yaml"
    file.write_text(dump_yaml(stated))
    random = np.random.default_rng(4)
    air = emulated_capture(true, Bench({}, {}), np.eye(4), "air", file=file, random=random)
    diagnosis = diagnose_captures([air], stated)[0].diagnosis
    assert "tone_curve" not in [effect.kind for effect in diagnosis.effects]
