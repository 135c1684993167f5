"""Promise 13 for campaigns: what differs between runs is refused in words, or kept apart; and `verify` and `repair`."""

import json
import shutil

import h5py
import pytest

from processing.storage.captures.capture import Capture

#: Where the campaign was taken, once, and a copy of it as it was then: its files name each other by whole paths.
TAKEN = {}


@pytest.fixture
def campaign(quick_rig, configs, tmp_path, acquire):
    """A campaign of one short capture, complete; its rig and plan are files that a test may edit."""
    home = TAKEN.setdefault("home", tmp_path)
    rig, plan, file = home / "rig.yaml", home / "plan.yaml", home / "campaign.yaml"

    def run(*options, rig=rig):
        chosen = () if rig is None else ("--rig", rig)
        return acquire("--campaign", file, *chosen, "--out", home, "--yes", *options)

    copy = home.with_name(home.name + " as it was")
    if copy.exists():
        shutil.rmtree(home, ignore_errors=True)
        shutil.copytree(copy, home)
        return run, rig, plan, home / "night"
    text = (configs / "plans" / "drr.yaml").read_text()
    plan.write_text(text.replace("states: 40, step_deg: 9", "states: 18, step_deg: 20").replace("darks: 4", "darks: 1"))
    file.write_text(
        f"kind: campaign\nname: night\nplans: {{drr: {plan}}}\nsamples: [{{name: red_sphere}}]\n"
        "wavelengths_nm: [662]\nomega_deg: [35]\n"
    )
    assert quick_rig() == rig
    code, _, err = run()
    assert code == 0, err
    shutil.copytree(home, copy)
    return run, rig, plan, home / "night"


def _only(folder):
    (path,) = folder.glob("*.h5")
    return path


def test_what_differs_is_refused_in_words_or_kept_apart(campaign, intact):
    run, rig, plan, folder = campaign
    before = {path.name: path.read_bytes() for path in folder.glob("*.h5")}
    # Without --rig it would go on with the simulated rig of the repository.
    code, _, err = run(rig=None)
    assert code == 2
    assert f"it was started with --rig {rig}" in err
    assert "rig.simulator.rows: 64 at the start, 600 now" in err
    for file, old, new, words in (
        (plan, "exposure_s: 0.02", "exposure_s: 0.002", "plan.exposure_s: 0.02 at the start, 0.002 now"),
        (rig, "gain_e_per_count: 2.6", "gain_e_per_count: 1.3", "gain_e_per_count: 2.6 at the start, 1.3 now"),
    ):
        text = file.read_text()
        file.write_text(text.replace(old, new))
        code, _, err = run()
        assert code == 2
        assert words in err
        if file == plan:
            code, out, err = run("--as-new")
            assert code == 0, err
            assert "1 of 1 captures complete" in out
            assert intact(_only(folder.with_name("night-2"))) == 19
        file.write_text(text)
    assert {path.name: path.read_bytes() for path in folder.glob("*.h5")} == before
    code, out, _ = run()
    assert code == 0


def test_a_foreign_file_under_the_expected_name_is_refused(campaign, acquire, tmp_path):
    run, rig, plan, folder = campaign
    path = _only(folder)
    acquire.made("--omega", 40, "--plan", plan, "--rig", rig, "--out", tmp_path / "other")
    shutil.copy(_only(tmp_path / "other"), path)
    code, _, err = run()
    assert code == 2
    assert "plan.omega_deg: 40.0 at the start, 35.0 now" in err


def test_a_half_sealed_file_is_no_dead_end_and_strays_are_named(campaign, acquire, intact):
    run, _, _, folder = campaign
    path = _only(folder)
    index = json.loads((folder / "index.json").read_text())
    for status in (b"complete", b"running"):
        partial = path.rename(path.with_name(path.name + ".partial"))
        with h5py.File(partial, "r+") as h5:
            h5["entry"].attrs.modify("status", status)
        (folder / "099_stray.h5.new").write_bytes(b"half")
        (folder / "index.json").write_text("{damaged")
        code, out, _ = acquire("verify", folder)
        assert "repair seals it" in out
        assert "099_stray.h5.new" in out
        if status == b"complete":
            code, out, _ = acquire("repair", folder)
            assert code == 0, out
            assert not list(folder.glob("*.new"))
        else:
            code, _, err = run()
            assert code == 0, err
        assert json.loads((folder / "index.json").read_text()) == index
        assert intact(path) == 19
    with Capture(path) as capture:
        assert capture.status == "complete"


def test_a_damaged_state_is_named_and_taken_again(campaign, acquire, intact):
    run, _, _, folder = campaign
    path = _only(folder)
    with h5py.File(path, "r+") as h5:
        h5["entry/instrument/detector/data"][7, 0, 30, 40] ^= 4
        h5["entry/states/exposure_s"][11] = 5.0
    code, out, _ = acquire("verify", folder)
    assert code == 1
    assert "DAMAGED: state 7, 11" in out
    code, out, _ = acquire("repair", folder)
    assert "state 7, 11 marked as not taken" in out
    code, _, err = run()
    assert code == 0, err
    assert intact(path) == 19
    code, out, _ = acquire("verify", folder)
    assert code == 0, out
    assert "2 runs" in out
