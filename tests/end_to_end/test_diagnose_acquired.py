"""`diagnose` on what `acquire` writes: the rig as it is described, and with a fault that nobody declared."""

import json
from pathlib import Path

import pytest

from processing.commands import diagnose as cli


@pytest.fixture
def diagnosed(acquire, small_rig, configs, tmp_path):
    """Acquires the red sphere, three quarters of whose image are dark, and returns what `diagnose` says of it."""

    def run(effects: list[dict[str, object]]) -> dict:
        code, _, err = acquire(
            "--omega", 35, "--rig", small_rig(effects=effects, rows=120, columns=120), "--out", tmp_path
        )
        assert code == 0, err
        (capture,) = Path(tmp_path).glob("*.h5")
        out = tmp_path / "said.json"
        with pytest.raises(SystemExit) as ended:
            cli.main([str(capture), "--instrument", str(configs / "instruments/rgb950.yaml"), "--json", str(out)])
        assert ended.value.code == 0
        return json.loads(out.read_text())

    return run


def test_a_rig_as_described_is_consistent(diagnosed):
    said = diagnosed([])
    assert said["verdict"] == "consistent"
    assert said["error_before"]["chi2_reduced"] == pytest.approx(1, abs=0.03)
    assert said["captures"][0]["dark_fraction"] > 0.3


@pytest.mark.parametrize(
    ("fault", "kind", "name", "true"),
    [
        ({"kind": "angle_offset", "axis": "psg", "offset_deg": 0.5}, "psg_azimuth", "azimuth", 0.5),
        # The rim of the sphere moves too: no derivative of the image tells what a shift does there.
        ({"kind": "image_drift", "axis": "psa", "wedge_pixels": 0.4}, "beam_wander", "x_cos", 0.4),
    ],
)
def test_an_undeclared_fault_is_found(diagnosed, fault, kind, name, true):
    said = diagnosed([fault])
    assert said["verdict"] == "explained"
    (effect,) = said["effects"]
    assert effect["kind"] == kind
    found = effect["parameters"][name]
    assert found["value"] == pytest.approx(true, abs=3 * found["stderr"])
