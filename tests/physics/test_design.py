"""State design: the known figures of RGB950 (docs/conventions.md), the bound, predicted errors by Monte Carlo."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from processing.calibration.state_design import (
    AssumedNoise,
    equally_weighted_variance,
    optimize,
    read_table,
    rows_of_design,
    score,
    two_retarders,
)
from processing.commands.application import app
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel, rank
from processing.instrument.states import rotating_retarders

NOISE = AssumedNoise(electrons=20_000, read_noise_e=3)
MODEL = InstrumentModel.load(Path(__file__).parents[2] / "configs/instruments/rgb950.yaml").at(662)
BOTH_127 = np.deg2rad(127.0), np.deg2rad(127.0)


def test_the_labs_own_table() -> None:
    figures = score(MODEL.rows(rotating_retarders(0.1).angles_deg), NOISE)
    assert figures.rank == 16
    assert figures.condition_number == pytest.approx(7.14, abs=0.005)
    assert figures.equally_weighted_variance == pytest.approx(86.3, abs=0.05)
    assert figures.bound == 40


def test_127_degrees_on_both_sides() -> None:
    w = rows_of_design(40, 4.91, *BOTH_127, zeros_rad=(0.0, 0.0, 0.0))
    assert equally_weighted_variance(w) == pytest.approx(50.3, abs=0.05)


def test_ratio_five_with_forty_steps_has_rank_12() -> None:
    figures = score(MODEL.rows(rotating_retarders(0.1, ratio=5.0).angles_deg), NOISE)
    assert figures.rank == 12
    assert figures.equally_weighted_variance == np.inf


def test_the_instrument_of_ratio_five_needs_other_steps(configs: Path) -> None:
    model = InstrumentModel.load(configs / "instruments/drr_5to1.yaml")
    assert rank(model.rows(rotating_retarders(1.0, 40, 9.0, 5.0).angles_deg)) == 12
    assert rank(model.rows(rotating_retarders(1.0, 30, 6.0, 5.0).angles_deg)) == 16


def test_ideal_rows_are_those_of_the_instrument_model() -> None:
    generator, analyzer = two_retarders(MODEL)
    w = MODEL.rows(rotating_retarders(0.1).angles_deg).reshape(40, 16)
    zeros = tuple(np.deg2rad([-17.02, 13.41, -0.53]))
    rows = rows_of_design(40, 4.91, np.deg2rad(127.12), np.deg2rad(94.78), zeros_rad=zeros)
    np.testing.assert_allclose(rows, w, atol=1e-14)
    assert (generator.axis, analyzer.axis) == ("psg", "psa")


def test_states_spread_evenly_over_both_spheres_reach_the_bound() -> None:
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    s = 0.5 * np.concatenate([np.ones((4, 1)), corners], axis=1)
    w = np.einsum("ai,gj->agij", s, s).reshape(16, 16)
    figures = score(w, NOISE)
    assert figures.equally_weighted_variance == pytest.approx(figures.bound) == pytest.approx(100)


def test_predicted_errors_of_every_element() -> None:
    w = MODEL.rows(rotating_retarders(0.1).angles_deg).reshape(40, 16)
    figures = score(w, NOISE)
    rng = np.random.default_rng(5)
    m00 = NOISE.electrons / w[:, 0].mean()
    signal = m00 * w[:, 0]
    frames = rng.poisson(signal, size=(20_000, 40)) + rng.normal(0, NOISE.read_noise_e, size=(20_000, 40))
    scatter = (frames @ np.linalg.pinv(w).T).std(axis=0) / m00
    np.testing.assert_allclose(scatter.reshape(4, 4), figures.element_stderr, rtol=5 / np.sqrt(2 * 20_000))


def test_optimizing_finds_better_retardances_and_ratios() -> None:
    (retardances,) = optimize(MODEL, NOISE, [40], {"retardances": True}, ratio=4.91)
    assert retardances.ratio == 4.91
    assert retardances.score.equally_weighted_variance < 50.3
    (ratio,) = optimize(MODEL, NOISE, [40], {"ratio": True}, ratio=4.91)
    assert (ratio.generator_retardance_deg, ratio.analyzer_retardance_deg) == pytest.approx((127.12, 94.78))
    assert ratio.score.equally_weighted_variance < 86.3
    table = ratio.table(("psg", "psa"))
    figures = score(MODEL.rows(table.angles_deg), NOISE)
    assert figures.equally_weighted_variance == pytest.approx(ratio.score.equally_weighted_variance)
    for design in (retardances, ratio):
        assert design.score.equally_weighted_variance > design.score.bound


def test_more_states_are_better() -> None:
    designs = optimize(MODEL, NOISE, [24, 48], {"retardances": True}, ratio=4.91)
    assert [d.states for d in designs] == [24, 48]
    assert designs[1].score.equally_weighted_variance < designs[0].score.equally_weighted_variance


def test_what_cannot_be_designed(configs: Path, tmp_path: Path) -> None:
    with pytest.raises(ProcessError, match="15 states cannot determine it"):
        optimize(MODEL, NOISE, [15], {}, ratio=4.91)
    imaging = InstrumentModel.load(configs / "instruments/drr_imaging_630nm.yaml").at(630)
    with pytest.raises(ProcessError, match="turning elements: psa_retarder, analyzer"):
        optimize(imaging, NOISE, [40], {}, ratio=4.91)
    with pytest.raises(ProcessError, match="positive signal"):
        AssumedNoise(0, 3)
    table = tmp_path / "states.csv"
    table.write_text("psg,psa\n0,0\n9,x\n")
    with pytest.raises(ProcessError, match="state line 3: column 'psa' holds no number"):
        read_table(table, ("psg", "psa"))
    table.write_text("psg\n0\n")
    with pytest.raises(ProcessError, match="found the columns: psg"):
        read_table(table, ("psg", "psa"))


def test_command(configs: Path, tmp_path: Path) -> None:
    instrument, table = str(configs / "instruments/rgb950.yaml"), tmp_path / "states.csv"
    shown = CliRunner().invoke(app, ["design", instrument, "--wavelength", "662", "--out", str(table)])
    assert shown.exit_code == 0, shown.output
    assert "condition number 7.142" in shown.output
    assert "equally weighted variance 86.33; the bound for 40 intensities is 40" in shown.output
    repeat = CliRunner().invoke(app, ["design", instrument, "--wavelength", "662", "--table", str(table)])
    assert repeat.output.splitlines()[1:] == shown.output.splitlines()[1:-1]
    best = CliRunner().invoke(app, ["design", instrument, "--wavelength", "662", "--optimize", "retardances"])
    assert "retardances 130.4 (generator) and 131.6 degrees (analyzer)" in best.output
    wrong = CliRunner().invoke(app, ["design", instrument])
    assert isinstance(wrong.exception, ProcessError)
    assert "choose one with --wavelength" in str(wrong.exception)
