"""Optics calibrated along a smooth curve over the wavelengths: smaller errors, honest ones, values in between."""

import numpy as np
import pytest
from typer.testing import CliRunner

from processing.calibration.known_sample import CalibrationError, KnownCapture
from processing.calibration.train import fit_curves, fit_trains
from processing.calibration.wavenumber_curve import WavenumberCurve
from processing.commands.application import app
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders

#: Electrons of a state in full light: weak at both ends, as with a lamp and a silicon sensor.
ELECTRONS = {420.0: 3e3, 480.0: 2e4, 540.0: 8e4, 600.0: 1e5, 660.0: 6e4, 720.0: 1e4}
HELD_OUT_NM = 570.0
ANGLES = dict(rotating_retarders(1.0, 24, 15.0, 4.91).angles_deg)
TURNED_DEG = {"psg_retarder": 0.7, "psa_retarder": -0.4}
FREE = [f"{plate}.{field}" for plate in TURNED_DEG for field in ("azimuth_deg", "retardance_deg")]


def retardance_deg(plate: str, wavelength_nm: float) -> float:
    """Of a crystal plate: the birefringence falls with the square of the wavelength (Cauchy)."""
    at_550, slope = {"psg_retarder": (127.0, 0.02), "psa_retarder": (118.0, 0.04)}[plate]
    x = 550 / wavelength_nm
    return at_550 * x * (1 + slope * (x**2 - 1))


def true_values(wavelength_nm: float) -> np.ndarray:
    return np.array([v for plate, deg in TURNED_DEG.items() for v in (deg, retardance_deg(plate, wavelength_nm))])


def plates(**more: object) -> InstrumentModel:
    """The file: nominal plates, the same retardance at every wavelength."""
    plate = {name: {"kind": "retarder", "name": name, "axis": name[:3], "retardance_deg": 120} for name in TURNED_DEG}
    return InstrumentModel.model_validate(
        {
            "name": "two plates",
            "generator": [{"kind": "polarizer", "name": "first"}, plate["psg_retarder"]],
            "analyzer": [plate["psa_retarder"], {"kind": "polarizer", "name": "last"}],
            **more,
        }
    )


def light(wavelength_nm: float) -> np.ndarray:
    """(N, channels) electrons of air."""
    values = {
        plate: {"azimuth_deg": deg, "retardance_deg": retardance_deg(plate, wavelength_nm)}
        for plate, deg in TURNED_DEG.items()
    }
    return ELECTRONS[wavelength_nm] * (plates().with_values(values).rows(ANGLES) @ np.eye(4).reshape(16))


def parts_of(model: InstrumentModel, seed: int) -> list[KnownCapture]:
    random = np.random.default_rng(seed)
    return [
        KnownCapture(model.at(nm), ANGLES, random.poisson(light(nm)).astype(float), np.eye(4), wavelength_nm=nm)
        for nm in ELECTRONS
    ]


@pytest.fixture(scope="module")
def repeated():
    """Noisy captures, and fits with curves of them."""
    captures = [parts_of(plates(), seed) for seed in range(5)]
    return [(parts, fit_curves(parts, FREE, 3)) for parts in captures]


@pytest.mark.long
def test_curves_have_smaller_errors_than_values_at_each_wavelength(repeated):
    truth = np.array([true_values(nm) for nm in ELECTRONS])
    separately = [fit_trains(parts, FREE) for parts, _ in repeated]
    smooth = np.array([[c.values for c in curves.calibrations] for _, curves in repeated]) - truth
    separate = np.array([[c.values for c in each] for each in separately]) - truth
    plates_only = [1, 3]
    unit = np.array([[c.stderr for c in each] for each in separately])
    smooth, separate = (np.mean((error / unit)[..., plates_only] ** 2) for error in (smooth, separate))
    # Three coefficients of six values: half the variance.
    assert smooth < 0.75 * separate
    for (_, curves), each in zip(repeated, separately, strict=True):
        for c, e in zip(curves.calibrations, each, strict=True):
            assert np.all(c.stderr[plates_only] < e.stderr[plates_only])


@pytest.mark.long
def test_error_bars_of_curves_are_those_of_the_noise(repeated):
    truth = np.array([true_values(nm) for nm in ELECTRONS])
    pulls = np.array(
        [[(c.values - t) / c.stderr for c, t in zip(f.calibrations, truth, strict=True)] for _, f in repeated]
    )
    between = [
        (f.at(plates(), HELD_OUT_NM).values - true_values(HELD_OUT_NM)) / f.at(plates(), HELD_OUT_NM).stderr
        for _, f in repeated
    ]
    # Five times eight independent numbers, and half as many between them.
    assert 0.7 < np.sqrt(np.mean(pulls**2)) < 1.3
    assert 0.5 < np.sqrt(np.mean(np.square(between))) < 1.5
    assert all(f.chance > 1e-3 for _, f in repeated)


def test_a_curve_too_stiff_is_told():
    stiff = fit_curves(parts_of(plates(), 0), FREE, 1)
    assert stiff.chance < 1e-6
    assert stiff.residual_over_mean > stiff.separate_residual


def test_fewer_wavelengths_than_coefficients_are_refused():
    with pytest.raises(
        CalibrationError, match="needs captures at 4 wavelengths or more; these are at 420, 480, 540 nm"
    ):
        fit_curves(parts_of(plates(), 0)[:3], FREE, 4)
    exact = fit_curves(parts_of(plates(), 0)[:3], FREE, 3)
    assert exact.chance is None
    each = fit_trains(parts_of(plates(), 0)[:3], FREE)
    assert np.allclose([c.values for c in exact.calibrations], [c.values for c in each], atol=1e-5)


def test_nothing_is_extrapolated():
    with pytest.raises(CalibrationError, match="outside the captures' 420 to 720 nm"):
        WavenumberCurve.over(list(ELECTRONS), 2).terms(730.0)


def test_the_file_may_keep_a_value_at_each_wavelength():
    name = "psa_retarder.retardance_deg"
    fitted = fit_curves(parts_of(plates(belongs_to={name: "wavelength"}), 0), FREE, 3)
    assert fitted.curved == ("psg_retarder.retardance_deg",)
    with pytest.raises(CalibrationError, match=f"{name}: no value at 570 nm"):
        fitted.at(plates(), HELD_OUT_NM)
    with pytest.raises(CalibrationError, match="follows a curve"):
        fit_curves(parts_of(plates(belongs_to={name: "wavelength"}), 0), [name], 3)


def test_a_curve_that_leaves_what_is_possible_is_refused():
    # Exactly zero: noise takes the curve below it somewhere.
    with pytest.raises(CalibrationError, match=r"the curve of last\.extinction is -.* where 0 to 1 is possible"):
        fit_curves(parts_of(plates(), 1), [*FREE, "last.extinction"], 3)


def test_command_tells_curves_and_writes_wavelengths_in_between(synthetic_capture, tmp_path):
    captures = []
    for nm in ELECTRONS:
        counts = np.random.default_rng(int(nm)).poisson(
            np.broadcast_to(light(nm)[:, :, None, None] / 2, (24, 1, 32, 32))
        )
        header = {"sample": {"kind": "air"}, "detector": {"black_level_counts": 0, "bits": 16}, "wavelength_nm": nm}
        captures.append(synthetic_capture(counts.astype(np.uint16), ANGLES, name=f"air{nm:g}.h5", **header))
    file, new = tmp_path / "nominal.yaml", tmp_path / "fitted.yaml"
    file.write_text(plates().model_dump_json(exclude_defaults=True), encoding="utf-8")
    options = [
        "--instrument",
        str(file),
        "--free",
        ",".join(FREE),
        "--dispersion",
        "3",
        "--at",
        "570",
        "--write",
        str(new),
    ]
    done = CliRunner().invoke(app, ["calibrate", *map(str, captures), *options])
    assert done.exit_code == 0, done.output
    assert "570 nm, from the curves" in done.output
    assert "with a value at each wavelength" in done.output
    fitted = InstrumentModel.load(new)
    for nm in (*ELECTRONS, HELD_OUT_NM):
        psg = fitted.at(nm).generator[1]
        assert psg.retardance_deg == pytest.approx(retardance_deg("psg_retarder", nm), abs=0.4), nm
    refused = CliRunner().invoke(app, ["calibrate", *map(str, captures), *options[:4], "--at", "570"])
    assert isinstance(refused.exception, CalibrationError)
    assert "give --dispersion as well" in str(refused.exception)
