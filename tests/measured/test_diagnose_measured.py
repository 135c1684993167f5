"""`diagnose` on real measurements: nothing is set for a data set beyond its train in YAML."""

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import optimize

from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.whole_bench import WholeBench
from processing.diagnosis.instrument_file import extend_model
from processing.diagnosis.search.fit import minimize, prior
from processing.diagnosis.search.space import Space
from processing.instrument.model import InstrumentModel
from processing.public_data.conversion import PublicStates, single_detector, tables_of
from processing.storage.captures.capture import Capture
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture

pytestmark = pytest.mark.measured


def imported(folder: Path, table: PublicStates, instrument: Path) -> Path:
    out = folder / f"{table.name}.h5"
    import_capture(
        ImportRequest(
            states=table.write(folder)[0],
            out=out,
            wavelength_nm=table.wavelength_nm,
            instrument=instrument,
            sample=read_sample(table.sample),
            overwrite=True,
        )
    )
    return out


def wollaston(public_files, folder: Path, instrument: Path, wavelength_nm: int) -> tuple[Path, np.ndarray]:
    """Capture of air, and the sum of both channels in the order of its states."""
    tables = tables_of("drr-wollaston-nir", public_files("drr-wollaston-nir"))
    table = next(t for t in tables if t.name == f"air_{wavelength_nm}nm")
    total = np.array([[float(word) for word in row.split(",")[2:]] for row in table.rows]).sum(axis=1)
    return imported(folder, table, instrument), total


# The level of the source is projected out: what is left is the ratio of the two channels.
@pytest.mark.parametrize(
    ("wavelength_nm", "least", "most", "sure"),
    [
        pytest.param(1200, 0.2, 0.27, {"psg_extinction"}, marks=pytest.mark.long),
        # A value for each intensity would leave 0.001 %, which says nothing.
        (1300, 0.1, 0.25, set()),
        pytest.param(1950, 0.2, 0.45, {"generator_ellipticity"}, marks=pytest.mark.long),
    ],
)
def test_wollaston_at_other_wavelengths(public_files, configs, tmp_path, wavelength_nm, least, most, sure):
    instrument = configs / "instruments/drr_wollaston.yaml"
    path, _ = wollaston(public_files, tmp_path, instrument, wavelength_nm)
    d = diagnose_captures([path], InstrumentModel.load(instrument))[0].diagnosis
    assert least < d.error_after.rms_percent < most
    assert sure <= {e.kind for e in d.effects if e.confident}
    assert d.correction.refused is None
    # At 1300 nm no cause is left.
    assert not sure or d.error_before.rms_percent > 2 * d.error_after.rms_percent


def telescope(public_files, folder: Path, instrument: Path) -> dict[int, Path]:
    """Captures of air by wavelength in nm."""
    tables = tables_of("dual-beam-charis-nir", public_files("dual-beam-charis-nir"))
    return {int(table.wavelength_nm): imported(folder, table, instrument) for table in tables}


@pytest.mark.long
def test_the_telescope_at_one_wavelength(public_files, configs, tmp_path):
    """By itself it does not tell what is depolarized: with that open nothing of M would be certain enough."""
    instrument = configs / "instruments/dual_beam_charis.yaml"
    path = telescope(public_files, tmp_path, instrument)[1686]
    model = InstrumentModel.load(instrument)
    plain = tuple(name for name in model.calibrate if not name.endswith("depolarization"))
    belongs = {name: rule for name, rule in model.belongs_to.items() if not name.endswith("depolarization")}
    d = diagnose_captures([path], model.model_copy(update={"calibrate": plain, "belongs_to": belongs}))[0].diagnosis
    # One angle for each ratio of two channels would leave less than the photon noise of 0.01 %. Whether what is found
    # is used is another question: one wavelength tells so little of M that it gets worse by a chance of 0.6 to 4 %.
    residual = next(check.after for check in d.correction.checks if check.name.startswith("rms on held-out data"))
    assert 0.02 < residual < 0.25


@pytest.mark.skipif("UMOV_SLOW" not in os.environ, reason="takes ten minutes: UMOV_SLOW=1")
@pytest.mark.timeout(1800)
def test_terms_of_even_wavelengths_predict_whole_states_of_odd_ones(public_files, configs, tmp_path):
    """Terms and their sizes are of the even wavelengths; their values are fitted to four fifths of the odd states."""
    instrument = configs / "instruments/dual_beam_charis.yaml"
    model = InstrumentModel.load(instrument)
    paths = [path for _, path in sorted(telescope(public_files, tmp_path, instrument).items())]
    found = diagnose_captures(paths[::2], model)[0].solution
    known: dict[tuple[str, str], list[np.ndarray]] = {}
    for c, part in found.space.pairs:
        known.setdefault((c.kind, c.place), []).append(found.weak[part] * c.typical**2)
    models, data = [], []
    for path in paths[1::2]:
        with Capture(path) as capture:
            models.append(model.nominal_at(capture.header.wavelength_nm))
            data.append(read_capture(capture, models[-1]))
    bench = WholeBench(InstrumentProblem(models, data), print)
    # As the moments of the captures are divided.
    fold = np.random.default_rng(0).permutation(data[0].conditions.states) % bench.problem.folds

    terms = [c for c in bench.pool if (c.kind, c.place) in known and not (c.effect.per_state or c.effect.is_nominal)]
    space = Space((*bench.base.candidates, *terms))
    start, weak = np.zeros(space.size), prior(space)
    for c, part in space.pairs:
        if c in bench.base.candidates:
            start[part] = bench.start[c]
        elif known[c.kind, c.place][0].size == c.size:
            weak[part] = np.mean(known[c.kind, c.place], axis=0) / c.typical**2
    start = minimize(bench.problem, space, start, weak=weak).values
    error = np.zeros((len(data), fold.size))
    for f in range(bench.problem.folds):
        others = [g for g in range(bench.problem.folds) if g != f]
        values = minimize(bench.problem, space, start, others, weak=weak).values
        for k, capture in enumerate(bench.problem.captures):
            told = (
                capture.matrix_of(bench.problem.models[k], bench.problem.changes(k, space, values)) @ capture.sample
            ).reshape(-1, 2)
            seen = capture.signal
            for c, part in space.pairs:
                if c.is_pointwise:
                    seen = c.effect.undo(seen, capture.conditions, c.place, values[part])[0]
            seen = seen.reshape(-1, 2)
            ratio = [(i[:, 0] - i[:, 1]) / i.sum(axis=1) for i in (seen, told)]
            error[k, fold == f] = (ratio[0] - ratio[1])[fold == f]
    # Rms of (left - right) / (left + right) in states that no fit saw, percent, mean over the wavelengths.
    assert 0.05 < 100 * np.sqrt((error**2).mean(axis=1)).mean() < 0.15


def test_values_at_a_bound_leave_the_others_at_their_minimum(public_files, configs, tmp_path):
    """Of depolarizations that noise takes below what is possible, and a far retardance: SciPy finds no lower one."""
    instrument = configs / "instruments/dual_beam_charis.yaml"
    model = InstrumentModel.load(instrument)
    paths = [path for _, path in sorted(telescope(public_files, tmp_path, instrument).items())][::4]
    models, data = [], []
    for path in paths:
        with Capture(path) as capture:
            models.append(model.nominal_at(capture.header.wavelength_nm))
            data.append(read_capture(capture, models[-1]))
    bench = WholeBench(InstrumentProblem(models, data), print)
    space, problem = bench.base, bench.problem
    fit = minimize(problem, space, space.vector(bench.start))
    lower, upper, typical = (space.joined(name) for name in ("lower", "upper", "typical"))
    assert np.any((fit.values <= lower) | (fit.values >= upper))

    def chi2(x):
        sums, weak = problem.sums(space, x * typical), prior(space) * x * typical
        slope = sums.gradient.sum(axis=0) + weak
        return sums.excess.sum() + weak @ (x * typical), 2 * slope * typical

    bounds = list(zip(lower / typical, upper / typical, strict=True))
    start = fit.values / typical
    best = optimize.minimize(chi2, start, jac=True, bounds=bounds, method="L-BFGS-B", options={"maxiter": 300})
    assert best.fun > chi2(start)[0] * (1 - 0.002)


def one_detector(public_files, folder: Path, instrument: Path, wavelength_nm: int, beside: int) -> Path:
    """Capture of air, the mean of so many rows (2 nm apart) on both sides of a wavelength."""
    (file,) = public_files("drr-single-detector-vis").values()
    return imported(folder, single_detector(file, wavelength_nm, beside), instrument)


@pytest.mark.long
def test_ten_wavelengths_share_their_mechanics(public_files, configs, tmp_path):
    instrument = configs / "instruments/drr_single_detector.yaml"
    paths = []
    for wavelength in range(450, 901, 50):
        paths.append(one_detector(public_files, tmp_path, instrument, wavelength, 0))
    d = diagnose_captures(paths, InstrumentModel.load(instrument))[0].diagnosis
    assert d.correction.refused is None
    assert d.error_after.rms_percent < 0.95 * d.error_before.rms_percent
    assert all(c.error_after.rms_percent < c.error_before.rms_percent for c in d.captures)
    named = [e for e in d.effects if e.confident and e.kind == "retarder_transmission"]
    assert {e.wavelength_nm for e in named} == set(d.wavelengths_nm)


# One row of the table has a noise of 0.75, 0.81 and 1.20 %; a mean of eleven (20 nm) has a third of it.
@pytest.mark.parametrize(
    ("wavelength_nm", "before", "after"),
    [
        pytest.param(450, 1.5, 0.6, marks=pytest.mark.long),
        pytest.param(850, 0.8, 0.55, marks=pytest.mark.long),
        pytest.param(1000, 2.0, 1.2, marks=pytest.mark.long),
    ],
)
def test_one_detector_behind_two_plates(public_files, configs, tmp_path, wavelength_nm, before, after):
    instrument = configs / "instruments/drr_single_detector.yaml"
    path = one_detector(public_files, tmp_path, instrument, wavelength_nm, 5)
    d = diagnose_captures([path], InstrumentModel.load(instrument))[0].diagnosis
    assert d.correction.refused is None
    assert d.error_before.rms_percent > before
    assert 0.3 < d.error_after.rms_percent < after


@pytest.mark.long
def test_wollaston_the_source_is_the_cause(public_files, configs, tmp_path):
    instrument = configs / "instruments/drr_wollaston.yaml"
    path, total = wollaston(public_files, tmp_path, instrument, 1600)
    judged, problem = diagnose_captures([path], InstrumentModel.load(instrument))
    d = judged.diagnosis
    # Two percent of flicker, in both channels alike, is gone before anything is fitted.
    assert d.error_after.rms_percent <= d.error_before.rms_percent < 0.3
    assert d.captures[0].source_percent == pytest.approx(100 * np.std(total) / np.mean(total), rel=0.2)
    # The values hold for all states together, not only for each part that was held out.
    image_sums = problem.undivided().sums(judged.solution.space, judged.solution.fit.values, derivatives=False)
    assert np.sqrt(image_sums.square.sum() / image_sums.count.sum()) < 0.003


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_gain_learnt_on_one_picture_mends_another(public_files, configs, tmp_path):
    instrument = configs / "instruments/linear_stokes.yaml"
    tables = {table.name: table for table in tables_of("dofp-imx250mzr", public_files("dofp-imx250mzr"))}

    def capture(name: str) -> Path:
        return imported(tmp_path, tables[name], instrument)

    model = InstrumentModel.load(instrument)
    learnt = diagnose_captures([capture("camera")], model)[0].diagnosis
    assert learnt.captures[0].closure_before_percent == pytest.approx(-2.085, abs=0.01)
    gain = next(e for e in learnt.effects if e.kind == "channel_gain")
    # Where the picture is curved, moving the four images to one place leaves something: nothing there is called sure.
    assert (gain.answer, learnt.verdict) == ("one of", "partly_explained")
    # What may be a part of something else is told as no more than likely.
    assert gain.probability == 0.9
    assert "channel_extinction" in gain.indistinguishable_from
    # Clipped pixels belong to the one picture; the gains of the channels belong to the camera.
    carried = extend_model(model, learnt).at(550)
    # What is carried is the mean over gains and extinctions, which these pictures cannot tell apart. The closure over
    # the gains sees the gains alone; the model's own residual sees both.
    picture, chi2 = capture("fruits"), []
    for instrument_model in (model.at(550), carried):
        with Capture(picture) as fruits:
            problem = InstrumentProblem(instrument_model, [read_capture(fruits, instrument_model)])
        sums = problem.sums(Space(()), np.zeros(0), derivatives=False)
        chi2.append(1 + sums.excess.sum() / sums.freedom.sum())
    assert chi2[0] > 2.5
    assert chi2[1] < 1.03


def test_the_middle_of_a_textured_picture_is_not_dark(public_files, configs, tmp_path):
    """A picture with a median of 12 counts of 255 and glossy highlights: its noise is not more than its signal."""
    (camera,) = (t for t in tables_of("dofp-imx250mzr", public_files("dofp-imx250mzr")) if t.name == "camera")
    picture = cv2.imread(camera.rows[0].split(",")[1], cv2.IMREAD_UNCHANGED)
    top, left = (picture.shape[0] - 600) // 2, (picture.shape[1] - 800) // 2
    cv2.imwrite(str(tmp_path / "middle.png"), picture[top : top + 600, left : left + 800])
    instrument = configs / "instruments/linear_stokes.yaml"
    path = imported(tmp_path, replace(camera, rows=(f"0,{tmp_path / 'middle.png'}",)), instrument)
    d = diagnose_captures([path], InstrumentModel.load(instrument))[0].diagnosis
    assert d.captures[0].dark_fraction < 0.5
    assert d.noise_floor_percent < 20
