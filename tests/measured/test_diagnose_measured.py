"""`diagnose` on real measurements: nothing is set for a data set beyond its train in YAML."""

import csv
import json
import os
from pathlib import Path

import numpy as np
import pytest

from processing.diagnosis.captured.read_capture import read_capture
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.run import diagnose_captures
from processing.diagnosis.instrument_file import extended
from processing.diagnosis.search.result import Check
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


def wollaston(shared_data: Path, folder: Path, instrument: Path, wavelength_nm: int) -> tuple[Path, np.ndarray]:
    """Capture of air, and the sum of both channels in the order of its states."""
    data = json.loads((shared_data / "drr-wollaston-nir/cal_results.json").read_text())
    theta, left, right = (np.array(data[f"Cal_{k}{wavelength_nm}"]) for k in ("theta", "Il_", "Ir_"))
    order = np.argsort(theta)
    lines = ["state,psg_deg,channel_left,channel_right"]
    lines += [f"{k},{np.rad2deg(theta[n]):.6f},{left[n]},{right[n]}" for k, n in enumerate(order)]
    return imported(folder, lines, instrument, wavelength_nm, "air"), (left + right)[order]


# With both channels at 1200 nm; the ratio alone is below.
@pytest.mark.parametrize(
    ("wavelength_nm", "least", "most", "sure"),
    [
        (1200, 0.2, 0.32, {"channel_gain", "channel_extinction"}),
        # A value for each intensity would leave 0.001 %, which says nothing.
        (1300, 0.1, 0.25, {"channel_gain"}),
        (1950, 0.2, 0.45, {"generator_ellipticity"}),
    ],
)
def test_wollaston_at_other_wavelengths(shared_data, configs, tmp_path, wavelength_nm, least, most, sure):
    instrument = configs / "instruments/drr_wollaston.yaml"
    path, _ = wollaston(shared_data, tmp_path, instrument, wavelength_nm)
    d = diagnose_captures([path], InstrumentModel.load(instrument))[0].diagnosis
    assert least < d.error_after.rms_percent < most
    assert sure <= {e.kind for e in d.effects if e.confident}


def test_where_the_source_counts_for_nothing_the_ratio_is_all(shared_data, configs, tmp_path):
    """`free_source` in the train: 46 ratios at 1200 nm, of which a level of the source for each state takes nothing."""
    file = configs / "instruments/drr_wollaston.yaml"
    instrument = tmp_path / "ratio.yaml"
    instrument.write_text(file.read_text(encoding="utf-8") + "free_source: true\n", encoding="utf-8")
    path, _ = wollaston(shared_data, tmp_path, instrument, 1200)
    d = diagnose_captures([path], InstrumentModel.load(instrument))[0].diagnosis
    assert d.correction.refused is None
    assert 0.1 < d.error_after.rms_percent < 0.27
    assert d.error_before.rms_percent > 2 * d.error_after.rms_percent
    assert any(e.confident for e in d.effects)


def telescope(shared_data: Path, folder: Path, instrument: Path) -> dict[int, Path]:
    """Captures of air by wavelength in nm, which are made as they are asked for."""
    by_wavelength: dict[int, list[str]] = {}
    with (shared_data / "dual-beam-charis-nir/fluxes.csv").open() as file:
        for r in csv.DictReader(file):
            lines = by_wavelength.setdefault(round(float(r["wavelength_nm"])), [])
            noise = float(r["stderr"]) / np.sqrt(2)
            lines.append(f"{len(lines)},{r['hwp_deg']},{r['image_rotator_deg']},{r['left']},{r['right']},{noise}")
    head = "state,hwp_deg,image_rotator_deg,channel_left,channel_right,sigma"
    out = {}
    for wavelength, lines in by_wavelength.items():
        (folder / str(wavelength)).mkdir()
        out[wavelength] = imported(folder / str(wavelength), [head, *lines], instrument, wavelength, "air")
    return out


def test_the_telescope_at_one_wavelength(shared_data, configs, tmp_path):
    """By itself it does not tell what is depolarized: with that open nothing of M would be certain enough."""
    instrument = configs / "instruments/dual_beam_charis.yaml"
    path = telescope(shared_data, tmp_path, instrument)[1686]
    model = InstrumentModel.load(instrument)
    plain = tuple(name for name in model.calibrate if not name.endswith("depolarization"))
    belongs = {name: rule for name, rule in model.belongs_to.items() if not name.endswith("depolarization")}
    d = diagnose_captures([path], model.model_copy(update={"calibrate": plain, "belongs_to": belongs}))[0].diagnosis
    # One angle for each ratio of two channels would leave less than the photon noise of 0.01 %. Whether what is found
    # is used is another question: one wavelength tells so little of M that it gets worse by a chance of 0.6 to 4 %.
    left = next(check.after for check in d.correction.checks if check.name.startswith("rms on held-out data"))
    assert 0.05 < left < 0.25


def held_out_of_each(
    shared_data: Path, configs: Path, tmp_path: Path, wavelengths: tuple[int, ...] | None
) -> list[Check]:
    """What a joint fit leaves at each wavelength of states that it did not see."""
    instrument = configs / "instruments/dual_beam_charis.yaml"
    paths = telescope(shared_data, tmp_path, instrument)
    chosen = [paths[nm] for nm in wavelengths or paths]
    d = diagnose_captures(chosen, InstrumentModel.load(instrument))[0].diagnosis
    assert d.correction.refused is None
    assert "angle_per_state" in {e.kind for e in d.effects}
    return [c for c in d.correction.checks if c.name.startswith("rms on held-out data of")]


def test_four_wavelengths_of_the_telescope_share_the_angles_of_their_states(shared_data, configs, tmp_path):
    told = held_out_of_each(shared_data, configs, tmp_path, (1575, 1744, 1932, 2139))
    assert len(told) == 4
    assert all(0.01 < c.after < 0.2 < c.before for c in told)


@pytest.mark.skipif("UMOV_SLOW" not in os.environ, reason="takes six minutes: UMOV_SLOW=1")
@pytest.mark.timeout(1800)
def test_all_wavelengths_of_the_telescope(shared_data, configs, tmp_path):
    told = held_out_of_each(shared_data, configs, tmp_path, None)
    assert len(told) == 22
    assert sum(c.after <= 0.25 for c in told) >= 18


def single_detector(shared_data: Path, folder: Path, instrument: Path, wavelength_nm: int, rows: int) -> Path:
    """Capture of air, the mean of so many rows (2 nm apart) on both sides of a wavelength."""
    table = np.genfromtxt(shared_data / "drr-single-detector-vis/air_2021.csv", delimiter=",", skip_header=1)
    at = int(np.argmin(np.abs(table[:, 0] - wavelength_nm)))
    lines = ["state,psg_deg,psa_deg,channel_camera"]
    lines += [f"{n},{6 * n},{30 * n},{v}" for n, v in enumerate(table[at - rows : at + rows + 1, 1:].mean(axis=0))]
    return imported(folder, lines, instrument, wavelength_nm, "air")


@pytest.mark.long
def test_ten_wavelengths_share_their_mechanics(shared_data, configs, tmp_path):
    instrument = configs / "instruments/drr_single_detector.yaml"
    paths = []
    for wavelength in range(450, 901, 50):
        (tmp_path / str(wavelength)).mkdir()
        paths.append(single_detector(shared_data, tmp_path / str(wavelength), instrument, wavelength, 0))
    d = diagnose_captures(paths, InstrumentModel.load(instrument))[0].diagnosis
    assert d.correction.refused is None
    assert d.error_after.rms_percent < 0.95 * d.error_before.rms_percent
    assert all(c.rms_after_percent < c.rms_before_percent for c in d.captures)
    named = [e for e in d.effects if e.confident and e.kind == "retarder_transmission"]
    assert {e.wavelength_nm for e in named} == set(d.wavelengths_nm)


# One row of the table has a noise of 0.75, 0.81 and 1.20 %; a mean of eleven (20 nm) has a third of it.
@pytest.mark.parametrize(("wavelength_nm", "before", "after"), [(450, 1.5, 0.6), (850, 0.8, 0.55), (1000, 2.0, 1.2)])
def test_one_detector_behind_two_plates(shared_data, configs, tmp_path, wavelength_nm, before, after):
    instrument = configs / "instruments/drr_single_detector.yaml"
    path = single_detector(shared_data, tmp_path, instrument, wavelength_nm, 5)
    d = diagnose_captures([path], InstrumentModel.load(instrument))[0].diagnosis
    assert d.correction.refused is None
    assert d.error_before.rms_percent > before
    assert 0.3 < d.error_after.rms_percent < after


def test_wollaston_the_source_is_the_cause(shared_data, configs, tmp_path):
    instrument = configs / "instruments/drr_wollaston.yaml"
    path, total = wollaston(shared_data, tmp_path, instrument, 1600)
    judged, problem = diagnose_captures([path], InstrumentModel.load(instrument))
    d = judged.diagnosis
    assert d.error_before.rms_percent > 2.0
    assert d.error_after.rms_percent < 0.16
    named = [e for e in d.effects if e.confident]
    assert [e.kind for e in named] == ["source_flicker"]
    assert d.verdict == "explained"
    # The values hold for all states together, with one throughput, not only for each part that was held out.
    whole = problem.undivided().sums(judged.found.space, judged.found.fit.values, derivatives=False)
    assert np.sqrt(whole.square.sum() / whole.count.sum()) < 0.002
    # Both channels saw it: their sum, which is modulated only as far as they differ, shows the same gains.
    gains = 1 + np.array(named[0].parameters["states"].value)
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
    # Where the picture is curved, moving the four images to one place leaves something: nothing there is called sure.
    assert (gain.answer, learnt.verdict) == ("one of", "partly_explained")
    assert gain.probability > 0.9
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
