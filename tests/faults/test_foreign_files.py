"""Promise 31: a data file of somebody else names no command, device or path that is used."""

import json

import pytest
from ruamel.yaml import YAML

from acquisition.errors import AcquisitionError
from acquisition.rig.own_rigs import is_own_rig, list_file, own_campaign

SHORT = {"states": {"kind": "table", "angles": {"psg": [0.0, 10.0, 20.0]}}, "darks": 1, "mode": "stokes"}


@pytest.fixture
def nobody(monkeypatch, tmp_path):
    """A user who has never used a rig file here."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))


@pytest.fixture
def foreign_capture(run_with, tmp_path):
    """A partial capture whose rig calls a command and writes a transcript; the rig file itself is gone."""

    def act(rig, state, retake):
        if state == 2:
            raise AcquisitionError("enough")

    touch = ["/bin/sh", "-c", f"touch {tmp_path / 'was_run'}"]
    top = {"alert": touch, "notify": {"command": touch}, "wire_log": str(tmp_path / "wires")}
    _, path = run_with(act, plan=SHORT, top=top)
    (tmp_path / "rig.yaml").rename(tmp_path / "gone.yaml")
    for file in (tmp_path / "wires").glob("*"):
        file.unlink()
    (tmp_path / "wires").rmdir()
    (tmp_path / "was_run").unlink(missing_ok=True)
    return path


def unused(tmp_path):
    return not (tmp_path / "was_run").exists() and not (tmp_path / "wires").exists()


@pytest.mark.parametrize("more", [(), ("--as-new",)])
def test_a_capture_is_resumed_with_a_rig_file_of_ones_own_only(nobody, foreign_capture, acquire, tmp_path, more):
    before = foreign_capture.read_bytes()
    err = acquire.refused("--resume", foreign_capture, *more)
    assert " ".join(("acquire --resume", str(foreign_capture), "--rig RIG.yaml", *more)) in err
    assert foreign_capture.read_bytes() == before
    assert unused(tmp_path)


def test_the_own_rig_file_says_what_is_run(nobody, foreign_capture, acquire, tmp_path):
    """The rig of the same name that was used before, although the file's own names other commands."""
    yaml = YAML()
    rig = yaml.load(tmp_path / "gone.yaml")
    command = ["/bin/sh", "-c", f"touch {tmp_path / 'mine_was_run'}"]
    rig |= {"notify": {"command": command}, "alert": []}
    del rig["wire_log"]
    yaml.dump(rig, tmp_path / "mine.yaml")
    code, out, err = acquire("--resume", foreign_capture, "--rig", tmp_path / "mine.yaml", "--dry-run")
    assert code == 0, out + err
    assert is_own_rig(tmp_path / "mine.yaml")
    code, out, err = acquire("--resume", foreign_capture)
    assert code == 0, out + err
    assert (tmp_path / "mine_was_run").exists()
    assert unused(tmp_path)


def test_a_damaged_list_is_begun_anew(nobody, quick_rig, acquire):
    list_file().parent.mkdir(parents=True)
    for text in ("{", "[]", '{"rigs": 3, "campaigns": {"/a": 5}}'):
        list_file().write_text(text)
        assert own_campaign(list_file().parent) is None
        rig = quick_rig()
        assert not is_own_rig(rig)
        assert acquire("--omega", 35, "--rig", rig, "--dry-run")[0] == 0
        assert is_own_rig(rig)
        assert list(json.loads(list_file().read_text())["rigs"]) == [str(rig)]


def test_a_campaign_among_captures_does_not_choose_the_rig(nobody, quick_rig, acquire, configs, tmp_path):
    rig = quick_rig(top={"alert": ["/usr/bin/touch", str(tmp_path / "was_run")]})
    folder = tmp_path / "night"
    folder.mkdir()
    (folder / "identity.json").write_text("{}")
    text = (configs / "campaigns").glob("*.yaml")
    yaml = YAML()
    campaign = yaml.load(sorted(text)[0])
    campaign["rig"] = str(rig)
    campaign["plans"] = {mode: str(configs / "plans" / f"{mode}.yaml") for mode in campaign["plans"]}
    yaml.dump(campaign, folder / "campaign.yaml")
    err = acquire.refused("--campaign", folder / "campaign.yaml", "--out", tmp_path / "out")
    assert f"acquire --campaign {folder / 'campaign.yaml'} --rig RIG.yaml" in err
    assert unused(tmp_path)
