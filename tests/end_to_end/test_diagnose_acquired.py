"""`diagnose` on what `acquire` writes: the rig as it is described, and with a fault that nobody declared."""

import json
import re
from pathlib import Path

import pytest

from processing.commands import diagnose as cli
from processing.instrument.model import InstrumentModel
from tests.commands import exit_code


@pytest.fixture
def diagnosed(acquire, small_rig, configs, tmp_path):
    """Acquires the red sphere, three quarters of whose image are dark, and returns what `diagnose` says of it."""

    def run(effects: list[dict[str, object]]) -> dict:
        code, _, err = acquire(
            "--omega", 35, "--rig", small_rig(effects=effects, rows=120, columns=120), "--out", tmp_path
        )
        assert code == 0, err
        (capture,) = Path(tmp_path).glob("*.h5")
        out, new = tmp_path / "said.json", tmp_path / "new.yaml"
        # Without --instrument it is the model in the capture.
        assert exit_code(cli.main, capture, "--json", out, "--write", new) == 0
        return json.loads(out.read_text())

    return run


@pytest.mark.long
def test_a_rig_as_described_is_consistent(diagnosed, configs, tmp_path, capfd):
    report = diagnosed([])
    assert report["verdict"] == "consistent"
    assert report["error_before"]["chi2_reduced"] == pytest.approx(1, abs=0.03)
    assert report["captures"][0]["dark_fraction"] > 0.3
    # Nothing is corrected, and by how much M may be off all the same is told, and written for its error bars.
    assert report["error_after"] == report["error_before"]
    streams = capfd.readouterr()
    assert "nothing is corrected" in streams.out
    assert "grows" not in streams.out
    assert re.search(r"M/m00 may still be off by [\d.e-]+ \(rms of its elements\), most in M(?!00)\d\d by", streams.out)
    declared, new = (InstrumentModel.load(f) for f in (configs / "instruments/rgb950.yaml", tmp_path / "new.yaml"))
    # A capture holds its instrument at its own wavelength.
    assert new.model_copy(update={"systematic": ()}) == declared.at(662)
    assert new.systematic[0].rms_over_m00 == pytest.approx(report["correction"]["mueller"]["rms"])
    assert "nothing is corrected" in (tmp_path / "new.yaml").read_text().splitlines()[0]


@pytest.mark.long
def test_an_undeclared_fault_is_found_and_explains_what_is_below_the_noise(diagnosed, capfd):
    """A slip that is seen beyond doubt leaves the rms of single pixels under its bound, before and after."""
    report = diagnosed([{"kind": "angle_slip", "axis": "psa", "at_index": 13, "slip_deg": 0.8}])
    assert report["verdict"] == "explained"
    (effect,) = report["effects"]
    # The first four of its turns are those of darks.
    assert (effect["kind"], effect["element"]) == ("rotation_slip", "psa@9")
    slip = effect["parameters"]["slip"]
    assert slip["value"] == pytest.approx(0.8, abs=3 * slip["stderr"])
    text = capfd.readouterr().out
    value, error = map(
        float, re.search(r"beyond noise under [\d.]+ % \(([\d.]+) ± ([\d.]+) % explained\)", text).groups()
    )
    # The explained part is as many of its errors from zero as the slip.
    assert value / error == pytest.approx(slip["value"] / slip["stderr"], rel=0.2)
