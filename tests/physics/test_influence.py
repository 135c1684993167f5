"""`process show` lists what a file of `diagnose` holds, for which captures, and what each value does to M."""

import pytest
from typer.testing import CliRunner

from processing.commands.application import app
from processing.instrument.influence import influences
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.yaml_file import dump_yaml


def effect(kind, element=None, unit="degree", **of):
    fields = {key: of.pop(key) for key in ("scope", "captures", "wavelength_nm") if key in of}
    values = {name: EffectParameter(value=value, stderr=abs(value) / 10, unit=unit) for name, value in of.items()}
    return AppliedEffect(kind=kind, element=element, parameters=values, **fields)


@pytest.fixture
def written(configs):
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    effects = (
        effect("psg_retardance", "psg_retarder", retardance=1.0, wavelength_nm=662.0),
        effect("source_drift", unit="1", change=0.1, scope="capture", captures=("air",), wavelength_nm=662.0),
        effect("tone_curve", unit="1", gamma_minus_1=0.01, wavelength_nm=662.0),
    )
    return model.model_copy(update={"effects": effects, "stderr": {"analyzer.azimuth_deg": 0.02}})


def test_a_degree_of_retardance_changes_air_by_what_a_degree_does(written):
    changes = {influence.name: influence for influence in influences(written, 662.0)}
    assert len(changes) == 4
    # One element of M, in the plane of the plate, moves by up to one degree: 0.0175 over the root of 15 elements.
    assert 0.002 < changes["psg_retardance[psg_retarder] at 662 nm"].change < 0.0175
    # 0.02 degrees of the analyzer turn some elements of M by 0.04 degrees.
    assert changes["analyzer.azimuth_deg"].change == pytest.approx(2 * 0.02 / 57.3 * (2 / 15) ** 0.5, rel=0.5)
    assert changes["tone_curve at 662 nm"].change is None


def test_the_command_says_for_which_captures(written, tmp_path):
    path = tmp_path / "new.yaml"
    path.write_text(dump_yaml(written), encoding="utf-8")
    shown = CliRunner().invoke(app, ["show", str(path), "--wavelength-nm", "662"])
    assert shown.exit_code == 0, shown.output
    assert "holds for air alone, at 662 nm" in shown.output
    assert "holds for later captures at 662 nm" in shown.output
    assert "holds for later captures at all wavelengths; one standard error changes M" in shown.output
    assert "-0.53" in shown.output
    assert "0.020" in shown.output


def test_without_a_wavelength_each_effect_is_taken_at_its_own(configs):
    train = InstrumentModel.load(configs / "instruments/drr_wollaston.yaml")
    at = (
        effect("psg_extinction", "psg_polarizer", unit="1", extinction=0.004, wavelength_nm=nm) for nm in (1200, 1300)
    )
    first, second = influences(train.model_copy(update={"effects": tuple(at)}))
    # A polarizer of 1 : 250 takes 0.8 % from nine elements of M, three of which air has.
    assert first.change == pytest.approx(0.008 * (3 / 15) ** 0.5, rel=0.1)
    assert second.change == pytest.approx(first.change, rel=1e-6)
