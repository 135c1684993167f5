"""`acquire --campaign`: the whole is checked first, and the same command goes on where it stopped."""

import json
import threading

import numpy as np
import pytest

from processing.storage.captures.capture import Capture


@pytest.fixture
def campaign(tmp_path):
    """Writes a small campaign file; keywords replace its lines."""

    def write(**lines):
        plan = "kind: plan\nmode: {mode}\nstates: {states}\nexposure_s: 0.004\ndarks: 1\n"
        for mode, states in (
            ("drr", "{kind: rotating_retarders, states: 18, step_deg: 20}"),
            ("stokes", "{kind: fixed, states: 2}"),
        ):
            (tmp_path / f"{mode}.yaml").write_text(plan.format(mode=mode, states=states))
        content = {
            "kind": "campaign",
            "name": "small",
            "plans": "{drr: drr.yaml, stokes: stokes.yaml}",
            "samples": "[{name: red_sphere}]",
            "wavelengths_nm": "[662]",
            "omega_deg": "[60, 40]",
            "references": "[{sample: {kind: air, name: air}, omega_deg: 180, modes: [drr]}]",
        } | lines
        path = tmp_path / "campaign.yaml"
        path.write_text("".join(f"{key}: {value}\n" for key, value in content.items() if value is not None))
        return path

    return write


NAMES = [
    "001_air_drr_662nm_omega180.h5",
    "002_red_sphere_drr_662nm_omega40.h5",
    "003_red_sphere_drr_662nm_omega60.h5",
    "004_red_sphere_stokes_662nm_omega40.h5",
    "005_red_sphere_stokes_662nm_omega60.h5",
]


@pytest.mark.long
def test_campaign_takes_everything_once(acquire, small_rig, campaign, tmp_path):
    arguments = ("--campaign", campaign(), "--rig", small_rig(), "--out", tmp_path)
    out = acquire.made(*arguments)
    folder = tmp_path / "small"
    assert sorted(path.name for path in folder.glob("*.h5")) == NAMES
    assert "5 of 5 captures complete" in out
    for name in NAMES:
        with Capture(folder / name) as capture:
            assert capture.status == "complete"
            assert capture.simulated
    # The rotators go on to the next turn instead of unwinding: no state lies below the one before.
    turned = [Capture(folder / name).angles_deg["psa"] for name in NAMES[:3]]
    assert np.all(np.diff(np.concatenate(turned)) > -1e-3)
    events = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert [event["event"] for event in events].count("capture ended") == 5
    assert "place the sample: air" in events[1]["operator"]
    index = json.loads((folder / "index.json").read_text())
    assert [entry["status"] for entry in index.values()] == ["complete"] * 5
    before = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")}
    acquire.made(*arguments)
    assert {path.name: path.stat().st_mtime_ns for path in folder.glob("*.h5")} == before


@pytest.mark.long
def test_stopped_campaign_goes_on_with_the_state_it_stopped_at(acquire, small_rig, campaign, tmp_path, monkeypatch):
    from acquisition.screen.progress import ConsoleProgress
    from acquisition.stop_request import StopRequest

    requests = []
    enter = StopRequest.__enter__
    monkeypatch.setattr(StopRequest, "__enter__", lambda self: (requests.append(self), enter(self))[1])
    done = []

    def stop_in_the_second_capture(self, report):
        done.append(report.state)
        if len(done) == 19 + 8 and len(requests) == 1:
            requests[0].request()

    monkeypatch.setattr(ConsoleProgress, "state_done", stop_in_the_second_capture)
    arguments = ("--campaign", campaign(), "--rig", small_rig(), "--out", tmp_path)
    code, out, err = acquire(*arguments)
    assert code == 130, err
    assert "continues where it stopped" in out
    with Capture(tmp_path / "small" / NAMES[1]) as capture:
        stopped_at = len(capture.done)
        assert capture.status == "aborted"
    assert 8 <= stopped_at < 19
    done.clear()
    acquire.made(*arguments)
    assert len(done) == (19 - stopped_at) + 19 + 3 + 3
    with Capture(tmp_path / "small" / NAMES[1]) as capture:
        assert capture.status == "complete"
        assert len(capture.done) == 19


@pytest.mark.parametrize("goes_on", [False, True])
def test_a_door_open_between_captures(acquire, small_rig, campaign, tmp_path, monkeypatch, goes_on):
    from acquisition.campaign.run import CampaignRun

    take, names = CampaignRun.take, []

    def opened_before_the_second(self, capture, job):
        names.append(capture.name)
        if len(names) == 2:
            shutter = self.rig.simulation.emulators["shutter"]
            shutter.trip(True)
            threading.Timer(0.5, shutter.trip, (False,)).start()
        return take(self, capture, job)

    monkeypatch.setattr(CampaignRun, "take", opened_before_the_second)
    lines = {"retries": "3", "retry_wait_s": "1", "continue_after_interlock": str(goes_on).lower()}
    file = campaign(plans="{stokes: stokes.yaml}", references="[]", **lines)
    code, _, err = acquire("--campaign", file, "--rig", small_rig(), "--out", tmp_path)
    assert "the door is open" in err
    assert code == (0 if goes_on else 1)
    assert len(list((tmp_path / "small").glob("*.h5"))) == (2 if goes_on else 1)


def test_books_that_a_full_disc_cut_off_are_caught_up(acquire, small_rig, campaign, tmp_path):
    file = campaign(plans="{stokes: stokes.yaml}", references="[]")
    arguments = ("--campaign", file, "--rig", small_rig(), "--out", tmp_path)
    assert acquire(*arguments)[0] == 0
    index, log = tmp_path / "small" / "index.json", tmp_path / "small" / "log.jsonl"
    books = json.loads(index.read_text())
    index.write_text(json.dumps({name: {"status": "running"} for name in list(books)[:1]}))
    log.write_text(log.read_text()[:-30])
    out = acquire.made(*arguments)
    assert "2 of 2 captures complete" in out
    assert json.loads(index.read_text()) == books
    assert json.loads(log.read_text().splitlines()[-1])["event"] == "campaign complete"


def test_dry_run_lists_captures_time_space_and_checks(acquire, small_rig, campaign, tmp_path):
    out = acquire.made("--campaign", campaign(), "--rig", small_rig(), "--out", tmp_path, "--dry-run")
    assert all(name in out for name in NAMES)
    assert "limits of psa" in out
    assert "disc for the campaign" in out
    assert "nothing was moved" in out
    assert not (tmp_path / "small").exists()


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ({"omega_deg": "[40, 3]"}, ("forbidden", "omega3")),
        ({"omega_deg": "[40, 200]"}, ("limits of arm", "200")),
        # A turn further than a forbidden pose: not that it meets one.
        ({"omega_deg": "[40, 400]"}, ("limits of arm", "400")),
        ({"wavelengths_nm": "[662, 500]"}, ("500",)),
        ({"samples": "[{name: gold}]"}, ("gold",)),
        ({"omega_deg": "{start: 90, stop: 20, step: 5}"}, ("stop 20", "start 90")),
        ({"nmae": "x"}, ("campaign.yaml:8", "unknown key")),
    ],
)
def test_one_bad_capture_refuses_the_campaign_before_any_motion(acquire, small_rig, campaign, tmp_path, line, words):
    err = acquire.refused("--campaign", campaign(**line), "--rig", small_rig(), "--out", tmp_path)
    assert all(word in err for word in words), err
    assert "homing" not in err
    assert not list(tmp_path.glob("small/*.h5*"))


def test_another_campaign_in_the_same_folder_is_refused(acquire, small_rig, campaign, tmp_path):
    rig = small_rig()
    lines = {"plans": "{stokes: stokes.yaml}", "references": "[]"}
    assert acquire("--campaign", campaign(**lines), "--rig", rig, "--out", tmp_path)[0] == 0
    changed = campaign(**lines, omega_deg="[45]")
    assert "campaign.omega_deg" in acquire.refused("--campaign", changed, "--rig", rig, "--out", tmp_path)


@pytest.mark.long
def test_exposure_is_found_for_each_geometry(acquire, small_rig, campaign, tmp_path):
    file = campaign(exposure_s="{kind: auto}", plans="{drr: drr.yaml}", omega_deg="[40, 80]")
    acquire.made("--campaign", file, "--rig", small_rig(), "--out", tmp_path)
    exposures = {}
    for path in sorted((tmp_path / "small").glob("*.h5")):
        with Capture(path) as capture:
            assert capture.column("saturated_fraction").max() <= 1e-3
            brightest = max(np.percentile(capture.frames(k), 99.9) for k in range(1, 19))
            assert 0.5 < (brightest - 64) / (4095 - 64) < 0.9
            exposures[path.name[:3]] = capture.column("exposure_s")[0]
            assert capture.closing["camera_settings"]["exposure_s"] == pytest.approx(exposures[path.name[:3]], abs=2e-5)
    assert len(set(exposures.values())) == 3


def test_found_exposure_leaves_room_for_the_bracket(acquire, small_rig, tmp_path):
    plan = tmp_path / "plan.yaml"
    states = "{kind: rotating_retarders, states: 16, step_deg: 9, ratio: 4.91}"
    plan.write_text(f"kind: plan\nstates: {states}\nexposure_s: {{kind: auto}}\nbracket: [1, 8]\ndarks: 1\n")
    rig = small_rig(top={"exposure_s": [1e-5, 0.08]}, flux_e_per_s=2e5)
    code, _, err = acquire("--plan", plan, "--rig", rig, "--out", tmp_path)
    assert code == 0, err
    assert "the longest allowed" in err
    with Capture(next(tmp_path.glob("*.h5"))) as capture:
        np.testing.assert_allclose(np.unique(capture.column("exposure_s")), [0.01, 0.08])


def test_a_state_that_saturates_begins_the_capture_again(acquire, small_rig, tmp_path):
    # A lamp so unsteady that some state is much brighter than those probed.
    effects = [{"kind": "source_flicker", "sigma": 0.2}]
    plan = tmp_path / "plan.yaml"
    plan.write_text("kind: plan\nexposure_s: {kind: auto, target: 0.9}\ndarks: 1\n")
    air = ("--sample", "air", "--omega", 180)
    code, _, err = acquire("--plan", plan, *air, "--rig", small_rig(effects=effects), "--out", tmp_path)
    assert code == 0, err
    assert "beginning again" in err
    (path,) = tmp_path.glob("*.h5")
    with Capture(path) as capture:
        assert capture.status == "complete"
        assert capture.column("saturated_fraction").max() <= 1e-3
        assert len(set(capture.column("exposure_s"))) == 1
