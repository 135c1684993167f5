"""Captures at several wavelengths calibrated at once: mounts are shared, plates have their own retardances."""

import numpy as np
import pytest
from typer.testing import CliRunner

from processing.calibration.known_sample import KnownCapture, part_of
from processing.calibration.train import fit_trains
from processing.commands.application import app
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.storage.captures.capture import Capture

FREE = ["psg_retarder.azimuth_deg", "psg_retarder.retardance_deg", "psa_retarder.retardance_deg"]
TURNED_DEG = 0.7
#: What the plates are off by.
OFF_DEG = {451: (1.2, -0.8), 662: (-0.5, 0.4), 947: (0.3, 2.0)}


@pytest.fixture
def captures(synthetic_capture, configs):
    """Air at three wavelengths, with a plate that was mounted 0.7 degrees off and retardances of their own."""
    angles = dict(rotating_retarders(1.0, 24, 15.0, 4.91).angles_deg)
    random = np.random.default_rng(3)
    paths = []
    for nm, (first, second) in OFF_DEG.items():
        model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(nm)
        psg, psa = (next(e for e in model.elements() if e.name == f"{side}_retarder") for side in ("psg", "psa"))
        truth = model.with_values(
            {
                "psg_retarder": {
                    "azimuth_deg": psg.azimuth_deg + TURNED_DEG,
                    "retardance_deg": psg.retardance_deg + first,
                },
                "psa_retarder": {"retardance_deg": psa.retardance_deg + second},
            }
        )
        light = 20_000 * truth.rows(angles).reshape(-1, 16) @ np.eye(4).reshape(16)
        counts = random.poisson(np.broadcast_to(light[:, None, None, None], (24, 1, 20, 20)) + 100).astype(np.uint16)
        detector = {"black_level_counts": 100, "bits": 16}
        paths.append(
            synthetic_capture(
                counts, angles, name=f"air{nm}.h5", sample={"kind": "air"}, detector=detector, wavelength_nm=nm
            )
        )
    return paths


def parts_of(captures, model):
    parts = []
    for path in captures:
        with Capture(path) as capture:
            parts.append(part_of(capture, model.at(capture.header.wavelength_nm), slice(None), slice(None)))
    return parts


def test_mounts_are_shared_and_plates_are_not(captures, configs):
    parts = parts_of(captures, InstrumentModel.load(configs / "instruments/rgb950.yaml"))
    fits = fit_trains(parts, FREE)
    for (nm, off), part, fit in zip(OFF_DEG.items(), parts, fits, strict=True):
        nominal = {e.name: e for e in part.model.elements()}
        change = fit.values - [getattr(nominal[name.split(".")[0]], name.split(".")[1]) for name in FREE]
        assert np.abs((change - [TURNED_DEG, *off]) / fit.stderr).max() < 4, nm
        assert change[0] == pytest.approx(fits[0].values[0] + 17.02, abs=1e-9)
    # Three captures know the mount better than one.
    assert fits[0].stderr[0] < 0.75 * fit_trains(parts[:1], FREE)[0].stderr[0]


def test_what_the_file_says_of_an_axis_that_turns_with_the_wavelength_holds(captures, configs):
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    declared = model.model_copy(update={"belongs_to": {"psg_retarder.azimuth_deg": "dispersion"}})
    fits = fit_trains(parts_of(captures, declared), FREE)
    assert len({float(fit.values[0]) for fit in fits}) == len(captures)
    assert fits[0].stderr[0] == pytest.approx(fit_trains(parts_of(captures[:1], model), FREE)[0].stderr[0], rel=0.1)


def test_command_writes_all_wavelengths(captures, configs, tmp_path):
    file, new = configs / "instruments/rgb950.yaml", tmp_path / "fitted.yaml"
    options = ["--instrument", str(file), "--free", ",".join(FREE), "--write", str(new)]
    done = CliRunner().invoke(app, ["calibrate", *map(str, captures), *options])
    assert done.exit_code == 0, done.output
    for nm, (first, _) in OFF_DEG.items():
        old, fitted = (InstrumentModel.load(path).at(nm).generator[1] for path in (file, new))
        assert fitted.azimuth_deg - old.azimuth_deg == pytest.approx(TURNED_DEG, abs=0.02)
        assert fitted.retardance_deg - old.retardance_deg == pytest.approx(first, abs=0.1)
    # What no capture told is as it was.
    assert InstrumentModel.load(new).at(524).generator[1] == InstrumentModel.load(file).at(524).generator[1]


def test_a_source_that_flickers_does_not_move_the_values_of_two_channels(configs):
    """One throughput for all states would turn a flicker of 20 % into degrees."""
    model = InstrumentModel.load(configs / "instruments/drr_wollaston.yaml").at(662)
    true = model.with_values({"psg_retarder": {"azimuth_deg": 3.0}, "psa_retarder": {"retardance_deg": 94.0}})
    angles, random = {"psg": 4.0 * np.arange(46)}, np.random.default_rng(1)
    signal = true.rows(angles) @ np.eye(4).reshape(16) * random.uniform(0.8, 1.2, (46, 1))
    (fit,) = fit_trains([KnownCapture(model, angles, signal, np.eye(4))], ["psg_retarder.azimuth_deg", FREE[2]])
    assert fit.values == pytest.approx([3.0, 94.0], abs=1e-5)
