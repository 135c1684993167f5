"""`diagnose` on real measurements: nothing is set for a data set beyond its train in YAML."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from processing.diagnosis.captured.read_capture import read_capture
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.run import diagnose_captures
from processing.diagnosis.instrument_file import extended
from processing.diagnosis.search.space import Space
from processing.instrument.model import InstrumentModel
from processing.storage.capture import Capture
from processing.storage.importing import ImportRequest, import_capture, read_sample

pytestmark = pytest.mark.measured

EXACT_DEG = {0: 0.0, 23: 22.5, 45: 45.0, 68: 67.5, 90: 90.0, 113: 112.5, 135: 135.0, 158: 157.5}


def imported(folder: Path, lines: list[str], instrument: Path, wavelength_nm: float, sample: str) -> Path:
    states = folder / "states.csv"
    states.write_text("\n".join(lines) + "\n", encoding="utf-8")
    out = folder / "capture.h5"
    import_capture(
        ImportRequest(
            states=states,
            out=out,
            wavelength_nm=wavelength_nm,
            instrument=instrument,
            sample=read_sample(sample),
            overwrite=True,
        )
    )
    return out


def test_wollaston_the_source_is_the_cause(shared_data, configs, tmp_path):
    instrument = configs / "instruments/drr_wollaston.yaml"
    data = json.loads((shared_data / "drr-wollaston-nir/cal_results.json").read_text())
    theta, left, right = (np.array(data[k]) for k in ("Cal_theta1600", "Cal_Il_1600", "Cal_Ir_1600"))
    lines = ["state,psg_deg,channel_left,channel_right"]
    for k, n in enumerate(np.argsort(theta)):
        lines.append(f"{k},{np.rad2deg(theta[n]):.6f},{left[n]},{right[n]}")
    path = imported(tmp_path, lines, instrument, 1600, "air")
    judged, problem = diagnose_captures([path], InstrumentModel.load(instrument))
    d = judged.diagnosis
    assert d.error_before.rms_percent > 2.0
    assert d.error_after.rms_percent < 0.2
    named = [e for e in d.effects if e.confident]
    assert [e.kind for e in named] == ["source_flicker"]
    assert d.verdict == "explained"
    # The values hold for all states together, with one throughput, not only for each part that was held out.
    whole = problem.undivided().sums(judged.found.space, judged.found.fit.values, derivatives=False)
    assert np.sqrt(whole.square.sum() / whole.count.sum()) < 0.002
    # Both channels saw it: their sum, which is modulated only as far as they differ, shows the same gains.
    gains = 1 + np.array(named[0].parameters["states"].value)
    total = (left + right)[np.argsort(theta)]
    assert np.corrcoef(gains, total)[0, 1] > 0.95


@pytest.mark.timeout(900)
def test_mirror_frames_down_to_a_quarter_percent(shared_data, configs, tmp_path):
    instrument = configs / "instruments/drr_imaging_630nm.yaml"
    with (shared_data / "drr-imaging-630nm/roi_stats_630nm.csv").open() as file:
        rows = list(csv.DictReader(file))
    lines = ["state,psg_deg,psa_deg,analyzer_deg,channel_camera"]
    for k, row in enumerate(rows):
        psg, psa = (EXACT_DEG[int(row[f"{r}_retarder_deg_nominal_rounded"])] for r in ("psg", "psa"))
        lines.append(f"{k},{psg},{psa},{row['psa_polarizer_deg']},{row['roi_mean_dn']}")
    path = imported(tmp_path, lines, instrument, 630, "mirror")
    d = diagnose_captures([path], InstrumentModel.load(instrument))[0].diagnosis
    assert d.error_before.rms_percent == pytest.approx(1.42, abs=0.03)
    assert d.error_after.rms_percent < 0.25
    kinds = {e.kind for e in d.effects}
    assert {"path_retardance", "retarder_transmission", "analyzer_transmission", "rotation_eccentricity"} <= kinds


@pytest.mark.timeout(900)
def test_the_gain_learnt_on_one_picture_mends_another(shared_data, configs, tmp_path):
    instrument = configs / "instruments/linear_stokes.yaml"
    folder = shared_data / "dofp-imx250mzr"

    def capture(name: str) -> Path:
        (tmp_path / name).mkdir()
        file = folder / f"polanalyser_{name}_IMX250MZR.png"
        return imported(tmp_path / name, ["state,file", f"0,{file}"], instrument, 550, "unknown")

    model = InstrumentModel.load(instrument)
    learnt = diagnose_captures([capture("camera")], model)[0].diagnosis
    assert learnt.captures[0].closure_before_percent == pytest.approx(-2.085, abs=0.01)
    gain = next(e for e in learnt.effects if e.kind == "channel_gain")
    assert gain.confident
    assert "channel_extinction" in gain.indistinguishable_from
    # Clipped pixels belong to the one picture; the gains of the channels belong to the camera.
    carried = extended(model, learnt).at(550)
    # What is carried is the mean over gains and extinctions, which these pictures cannot tell apart. The closure over
    # the gains sees the gains alone; the model's own residual sees both.
    other, left = capture("fruits"), []
    for instrument_model in (model.at(550), carried):
        with Capture(other) as fruits:
            problem = InstrumentProblem(instrument_model, [read_capture(fruits, instrument_model)])
        sums = problem.sums(Space(()), np.zeros(0), derivatives=False)
        left.append(1 + sums.excess.sum() / sums.freedom.sum())
    assert left[0] > 2.5
    assert left[1] < 1.03
