"""What the camera is set to and what a capture makes of it: region, mosaic, trigger, darks that are not dark."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from drivers.cameras.aravis import AravisCamera
from processing.commands.application import main as process
from processing.storage.captures.capture import Capture
from simulators.camera.gige_camera import GigeCamera
from simulators.rig.rig import SimulatedRig
from tests.commands import exit_code

Rig = Callable[..., Path]
Acquire = Callable[..., tuple[int, str, str]]

CAMERA = {"kind": "aravis", "bits": 12, "packet_size": 9000}
STYLE = Path(__file__).parents[1] / "conformance" / "descriptions" / "in_the_style_of_makers.xml"
THROUGH = ("--sample", "air", "--omega", 180)


def run_process(*arguments: object) -> None:
    assert exit_code(process, *arguments) == 0


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        ({"settings": {"binning": 2}}, "mosaic_binning: like_with_like"),
        ({"settings": {"decimation": 2}}, "leaves out pixels"),
        ({"settings": {"reverse_x": True}}, "mirrors its frames"),
        ({"settings": {"width": 41, "height": 24}}, "no whole number of super-pixels"),
        ({"features": {"BinningVertical": 2}}, "columns and rows have 1 and 2"),
        ({"features": {"DecimationHorizontal": 2}}, "columns and rows have 2 and 1"),
        ({"features": {"ReverseY": True}}, "mirrors its frames"),
    ],
)
def test_a_mosaic_whose_analyzers_cannot_be_known_is_refused(
    acquire: Acquire, small_rig: Rig, short_plan: Callable[[str], Path], tmp_path: Path, camera: dict, says: str
) -> None:
    rig = small_rig(top={"camera": CAMERA | camera})
    code, _, err = acquire("--rig", rig, "--plan", short_plan("stokes"), *THROUGH, "--out", tmp_path / "captures")
    assert code != 0
    assert says in " ".join(err.split())
    assert not list(tmp_path.glob("captures/*"))


def test_a_camera_that_bins_like_with_like_may_bin_a_mosaic(
    acquire: Acquire, small_rig: Rig, short_plan: Callable[[str], Path], tmp_path: Path
) -> None:
    rig = small_rig(top={"camera": CAMERA | {"settings": {"binning": 2}, "mosaic_binning": "like_with_like"}})
    acquire.made("--rig", rig, "--plan", short_plan("stokes"), *THROUGH, "--dry-run")


@pytest.mark.parametrize("mode", ["stokes", "drr"])
def test_darks_that_are_not_dark_end_the_capture(
    acquire: Acquire,
    small_rig: Rig,
    short_plan: Callable[[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    mode: str,
) -> None:
    monkeypatch.setattr(SimulatedRig, "light", lambda self: 1.0)
    code, _, err = acquire("--rig", small_rig(), "--plan", short_plan(mode), *THROUGH, "--out", tmp_path / "captures")
    text = " ".join(err.split())
    assert code != 0
    assert "dark states of 0.005 s are as bright as a light state" in text
    assert "source darkens the sample" in text
    assert not list(tmp_path.glob("captures/*.h5"))


def test_a_rig_with_a_hardware_trigger_captures_with_it(
    acquire: Acquire, small_rig: Rig, short_plan: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras: list[GigeCamera] = []
    start, arm = GigeCamera.start, AravisCamera._do_trigger

    def started(self: GigeCamera) -> None:
        start(self)
        cameras.append(self)

    def armed(self: AravisCamera) -> None:
        arm(self)
        cameras[-1].fire()

    monkeypatch.setattr(GigeCamera, "start", started)
    monkeypatch.setattr(AravisCamera, "_do_trigger", armed)
    rig = small_rig(top={"camera": CAMERA | {"settings": {"trigger": "hardware"}}})
    out = tmp_path / "captures"
    acquire.made("--rig", rig, "--plan", short_plan("stokes"), *THROUGH, "--out", out)
    with Capture(next(out.glob("*.h5"))) as capture:
        assert json.loads(capture.header.camera_settings_json)["trigger"] == "hardware"
        assert capture.done.size == 2


def test_a_rotator_of_limited_travel_takes_the_same_states_half_a_turn_away(
    acquire: Acquire, small_rig: Rig, short_plan: Callable[[str], Path], tmp_path: Path
) -> None:
    limited = {
        "psg": {"kind": "zaber", "port": "sim:rotators", "address": 1},
        "psa": {"kind": "zaber", "port": "sim:rotators", "address": 2, "limits_deg": [-95, 95]},
        "arm": {"kind": "smc100", "port": "sim:arm", "address": 1, "limits_deg": [0, 180]},
    }
    plan, out = short_plan("drr", "states: {kind: rotating_retarders, states: 20}"), tmp_path / "captures"
    code, _, err = acquire("--rig", small_rig(top={"axes": limited}), "--plan", plan, *THROUGH, "--out", out)
    assert code != 0
    assert "fold_deg: {psa: 180}" in " ".join(err.split())
    rig = small_rig("folded.yaml", top={"axes": limited, "fold_deg": {"psa": 180}})
    acquire.made("--rig", rig, "--plan", plan, *THROUGH, "--out", out)
    with Capture(next(out.glob("*.h5"))) as capture:
        targets = capture.planned_targets_deg()
        assert capture.header.folded_deg == {"psa": 180}
        np.testing.assert_allclose((targets["psa"] - 4.91 * targets["psg"] + 90) % 180, 90, atol=1e-6)
        assert np.all(np.abs(capture.angles_deg["psa"]) <= 95)


@pytest.mark.long
def test_the_description_of_a_camera_itself_is_played(
    acquire: Acquire, small_rig: Rig, short_plan: Callable[[str], Path], tmp_path: Path
) -> None:
    settings = {"pixel_format": "Mono12p", "width": 48, "height": 32, "offset_x": 4, "offset_y": 5}
    rig = small_rig(top={"camera": CAMERA | {"settings": settings}}, camera="maker.xml")
    (rig.parent / "maker.xml").write_bytes(STYLE.read_bytes())
    out = tmp_path / "captures"
    acquire.made("--rig", rig, "--plan", short_plan("drr"), *THROUGH, "--out", out)
    (path,) = out.glob("*.h5")
    with Capture(path) as capture:
        assert capture.camera_nodes["DeviceModelName"] == "Style-3k"
        assert capture.frame_shape == (32, 48)
        assert capture.closing["stream"]["retakes"] == 0
    run_process("reduce", path, "--out", tmp_path / "air.h5")


def test_a_description_that_cannot_be_played_is_told_in_a_line(acquire: Acquire, small_rig: Rig) -> None:
    rig = small_rig(camera="maker.xml")
    (rig.parent / "maker.xml").write_text(STYLE.read_text().replace('"AcquisitionStop"', '"AcquisitionHalt"'))
    code, out, err = acquire("doctor", "--rig", rig)
    assert code != 0
    assert "feature AcquisitionStop is missing" in out + err
    assert "Traceback" not in out + err


def test_a_feature_table_that_is_not_there_is_named_with_those_that_are(acquire: Acquire, small_rig: Rig) -> None:
    code, out, _ = acquire("doctor", "--rig", small_rig(camera="lucid"))
    assert code != 0
    assert "no feature table 'lucid'" in out
    assert "lucid_tri050s_p" in out


def test_all_states_at_omega_35_on_the_node_map_of_the_paper_s_camera(
    acquire: Acquire, small_rig: Rig, tmp_path: Path
) -> None:
    settings = {"pixel_format": "Mono12p", "width": 40, "height": 32}
    # It does not tell when it exposes, and the simulated one begins later than a real one.
    camera = CAMERA | {"settings": settings, "trigger_latency_s": 0.02}
    rig = small_rig(top={"camera": camera}, camera="lucid_tri050s_p")
    out = tmp_path / "captures"
    acquire.made("--omega", 35, "--rig", rig, "--out", out)
    (path,) = out.glob("*.h5")
    with Capture(path) as capture:
        assert capture.status == "complete"
        assert [capture.states_with(role).size for role in ("dark", "sample")] == [4, 40]
        assert np.all(capture.column("camera_temperature_c") == 38.5)
        assert capture.camera_nodes["PixelFormat"] == "Mono12p"
        assert capture.closing["stream"]["stale_discarded"] == 0
        # An arming time of 20 ms: a trigger that came before would have been ignored, and its frame missed.
        assert capture.closing["stream"]["retakes"] == 0


def test_doctor_and_snap_need_no_signal_on_a_rig_with_a_hardware_trigger(
    acquire: Acquire, small_rig: Rig, tmp_path: Path
) -> None:
    rig = small_rig(top={"camera": CAMERA | {"settings": {"trigger": "hardware"}, "trigger_timeout_s": 0.5}})
    code, out, err = acquire("doctor", "--rig", rig, "--frames", 2)
    assert code == 0, out + err
    assert "0 of 2 frames lost" in out
    acquire.made("snap", "--rig", rig, "--out", tmp_path / "frame.npy", "--sample", "red_flat")
