"""Noise of few dark frames, and the rounding of counts: both are alike in many values, and are no fault."""

import numpy as np
import pytest

from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture

GAIN, READ, BLACK = 2.0, 6.0, 100
CROSSED = """
kind: instrument
name: crossed
generator:
  - {kind: polarizer, name: p1, azimuth_deg: 0}
  - {kind: retarder, name: psg_retarder, axis: psg, azimuth_deg: 0, retardance_deg: 90}
analyzer:
  - {kind: retarder, name: psa_retarder, axis: psa, azimuth_deg: 0, retardance_deg: 90}
  - {kind: polarizer, name: p2, azimuth_deg: 90}
"""
ANGLES = {"psg": 4.7 * np.arange(24), "psa": 23.1 * np.arange(24)}


@pytest.mark.parametrize(
    ("kind", "unknowns", "darks", "stated"), [("air", 1, 2, True), ("unknown", 16, 2, True), ("air", 1, 1, False)]
)
def test_noise_of_few_darks_is_expected_in_the_residual(kind, unknowns, darks, stated, synthetic_capture, configs):
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662)
    rows = model.rows(ANGLES).reshape(-1, 16)
    random = np.random.default_rng(8)
    # Dim, so that what the darks add is a good part of the noise.
    light = random.poisson(300 * (rows @ np.eye(4).ravel())[:, None, None, None], (24, 1, 50, 60))
    frames = np.concatenate([np.zeros((darks, 1, 50, 60)), light])
    frames = frames + random.normal(0, READ, frames.shape)
    path = synthetic_capture(
        np.round(frames / GAIN + BLACK).astype(np.uint16),
        {axis: np.r_[[0] * darks, turned] for axis, turned in ANGLES.items()},
        role=("dark",) * darks + ("sample",) * 24,
        sample={"kind": kind},
        instrument_yaml=(configs / "instruments/rgb950.yaml").read_text(),
        detector={"black_level_counts": BLACK, "bits": 16}
        | ({"gain_e_per_count": GAIN, "read_noise_e": READ} if stated else {}),
    )
    with Capture(path) as capture:
        data = read_capture(capture, model)
    a = rows @ np.eye(4).reshape(16, 1) if kind == "air" else rows
    signal = data.signal.reshape(24, -1).astype(float)
    residual = signal - a @ np.linalg.lstsq(a, signal, rcond=None)[0]
    outside = np.eye(24) - a @ np.linalg.pinv(a)
    variance = (data.slope * np.maximum(signal.mean(axis=1), 0) + data.floor) @ np.diag(outside)
    freedom = 3000 * (24 - unknowns)
    assert (residual**2).sum() / (3000 * variance) == pytest.approx(1, abs=3 * np.sqrt(2 / freedom))


SIXTEEN_BITS = 2.1, 4.0, 600.0, 16
# 0.24 and 0.15 counts of read noise: whole counts are off by up to a half, in all pixels alike.
EIGHT_BITS, QUIET = (490.0, 118.0, 8.4, 8), (490.0, 74.0, 8.6, 8)


@pytest.mark.parametrize(
    ("camera", "darks", "texture"),
    [
        pytest.param(SIXTEEN_BITS, 4, 0.5, marks=pytest.mark.long),
        (EIGHT_BITS, 1, 0.5),
        pytest.param(QUIET, 4, 0.0, marks=pytest.mark.long),
    ],
)
def test_noise_of_darks_is_no_fault_where_states_are_dark(camera, darks, texture, synthetic_capture):
    """Crossed polarizers let no light through in six of these states: the read-out and the darks are all the noise."""
    gain, read, black, bits = camera
    turned = 4.5 * np.arange(40)
    file = synthetic_capture.folder / "crossed.yaml"
    file.write_text(CROSSED)
    model = InstrumentModel.load(file)
    angles = {"psg": turned, "psa": 5 * turned}
    light = model.at(662).rows(angles).reshape(-1, 16) @ np.eye(4).ravel()
    random = np.random.default_rng(77)
    scene = 40_000 * (1 + texture * np.sin(np.arange(64) / 3) * np.cos(np.arange(48) / 5)[:, None])
    electrons = random.poisson(np.maximum(light, 0)[:, None, None, None] * scene)
    frames = np.concatenate([np.zeros((darks, 1, 48, 64)), electrons])
    frames = frames + random.normal(0, read, frames.shape)
    path = synthetic_capture(
        np.round(frames / gain + black).astype(np.uint16),
        {axis: np.r_[np.zeros(darks), a] for axis, a in angles.items()},
        role=("dark",) * darks + ("sample",) * 40,
        sample={"kind": "air"},
        instrument_yaml=CROSSED,
        detector={"gain_e_per_count": gain, "read_noise_e": read, "bits": bits},
    )
    diagnosis = diagnose_captures([path], model)[0].diagnosis
    assert (diagnosis.verdict, diagnosis.effects) == ("consistent", ())
    if camera == SIXTEEN_BITS:
        # Of 8 bits the rounding of the dark frames of single pixels is known less well than their noise.
        assert diagnosis.noise.verdict == "as_declared"


def test_darks_of_a_mosaic_take_no_slope_of_the_light(synthetic_capture, configs):
    """Channels that look at places apart differ in all states alike, as dark frames do. It was a sure field."""
    file = configs / "instruments/mosaic_polarimeter.yaml"
    model, gain, read, darks = InstrumentModel.load(file), 25.0, 50.0, 6
    angles = {"psg": 22.5 * np.arange(16)}
    rows = model.at(662).rows(angles) @ np.eye(4).ravel()
    random = np.random.default_rng(79)
    x, y = np.linspace(-1, 1, 58), np.linspace(-1, 1, 58)[:, None]
    light = np.zeros((darks + 16, 1, 58, 58))
    for k, channel in enumerate(model.channels):
        (r, c), *_ = np.argwhere(np.array(model.mosaic) == channel.name)
        light[darks:, 0, r::2, c::2] = rows[:, k, None, None] * (8000 * (1 - 0.4 * (x**2 + y**2)))[r::2, c::2]
    frames = random.poisson(light) + random.normal(0, read, light.shape)
    path = synthetic_capture(
        np.round(frames / gain + 20).astype(np.uint16),
        {"psg": np.r_[np.zeros(darks), angles["psg"]]},
        role=("dark",) * darks + ("sample",) * 16,
        sample={"kind": "air"},
        mosaic=model.mosaic,
        instrument_yaml=file.read_text(),
        detector={"gain_e_per_count": gain, "read_noise_e": read, "bits": 10},
    )
    found = diagnose_captures([path], model)[0].diagnosis
    assert (found.verdict, found.effects) == ("consistent", ())


@pytest.mark.long
def test_a_bend_is_named_where_read_noise_is_a_quarter_of_a_count(synthetic_capture):
    """What rounding may do to whole frames is no reason to look no longer at the noise of the light behind a bend."""
    turned, bend, gain = 4.5 * np.arange(40), 0.03, 1.3
    file = synthetic_capture.folder / "crossed.yaml"
    stated = CROSSED.replace("axis: psg, azimuth_deg: 0, retardance_deg: 90", "axis: psg, retardance_deg: 101")
    stated = stated.replace("axis: psa, azimuth_deg: 0, retardance_deg: 90", "axis: psa, retardance_deg: 121")
    file.write_text(stated)
    true = synthetic_capture.folder / "true.yaml"
    true.write_text(stated.replace("121", "120"))
    angles = {"psg": turned, "psa": 5 * turned}
    light = InstrumentModel.load(true).at(662).rows(angles).reshape(-1, 16) @ np.eye(4).ravel()
    random = np.random.default_rng(78)
    mean = np.maximum(light, 0)[:, None, None, None] * np.full((48, 64), 7_800.0)
    electrons = random.poisson(mean * (1 - bend * mean / (4095 * gain)))
    frames = np.concatenate([np.zeros((4, 1, 48, 64)), electrons])
    frames = frames + random.normal(0, 0.35, frames.shape)
    path = synthetic_capture(
        np.round(frames / gain + 8.3).astype(np.uint16),
        {axis: np.r_[np.zeros(4), a] for axis, a in angles.items()},
        role=("dark",) * 4 + ("sample",) * 40,
        sample={"kind": "air"},
        instrument_yaml=stated,
        detector={"gain_e_per_count": gain, "read_noise_e": 0.35, "bits": 12},
    )
    diagnosis = diagnose_captures([path], InstrumentModel.load(file))[0].diagnosis
    assert diagnosis.verdict == "explained"
    values = {effect.kind: next(iter(effect.parameters.values())) for effect in diagnosis.effects}
    plate, curve = values["psa_retardance"], values["detector_nonlinearity"]
    assert (plate.value, plate.stderr) == (pytest.approx(-1, abs=0.05), pytest.approx(0.01, abs=0.005))
    assert (curve.value, curve.stderr) == (pytest.approx(bend, abs=0.002), pytest.approx(0.0005, abs=0.0003))
