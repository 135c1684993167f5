"""Bad input of `acquire`: a clear message, an exit code, no traceback, nothing moved, nothing written."""

import shlex
from pathlib import Path

import pytest

from acquisition.capture.job import Result
from acquisition.commands.single import next_command
from tests.rig_files import change_yaml


@pytest.fixture
def refused(acquire, tmp_path):
    """Runs `acquire`, which must refuse without traceback or capture; returns exit code and message."""

    def run(*arguments):
        code, out, err = acquire(*arguments, "--out", tmp_path / "captures")
        assert code != 0
        assert "Traceback" not in out + err
        assert not list(tmp_path.glob("captures/*"))
        return code, err

    return run


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        (
            lambda r: r["modes"]["drr"].update(instrument="../instruments/rgb950.yaml"),
            2,
            ("modes.drr.instrument of the rig file: there is no file {folder}/instruments/rgb950.yaml",),
        ),
        (
            lambda r: r["modes"]["drr"].update(instrument="x" * 5000),
            2,
            ("modes.drr.instrument of the rig file: there is no file",),
        ),
        (lambda r: r["axes"]["psa"].update(adress=2), 2, ("rig.yaml:", "adress: unknown key")),
        (lambda r: r["axes"]["arm"].update(port="/dev/ttyNOTHERE"), 1, ("/dev/ttyNOTHERE", "no such port")),
        (lambda r: r.update(home_at_start=False), 1, ("acquire home", "arm, psg, psa")),
    ],
    ids=["path of another folder", "path that is too long", "key of an axis", "port", "no reference"],
)
def test_what_is_wrong_in_a_rig_file_is_told_in_a_line(refused, small_rig, change, code, words):
    rig = change_yaml(small_rig(), change)
    exit_code, err = refused("--omega", 35, "--rig", rig)
    assert exit_code == code
    assert all(word.format(folder=rig.parent.parent) in err for word in words), err
    assert max(map(len, err.splitlines())) < 700


@pytest.mark.parametrize(
    ("change", "row", "reason"),
    [
        ({"alert": ["/no/such/program"]}, "alert", "no program '/no/such/program'"),
        ({"notify": {"command": ["/no/such/teller"]}}, "notify", "no program '/no/such/teller'"),
        ({"samples": {"red_sphere": "nowhere.yaml"}}, "scene red_sphere", "nowhere.yaml"),
        ({"truth": {"drr": "nowhere.yaml"}}, "truth of drr", "nowhere.yaml"),
    ],
    ids=["alert", "notify", "scene", "truth"],
)
def test_what_is_not_on_this_machine_is_told_beside_the_rest(refused, acquire, small_rig, change, row, reason):
    """A rig file of the bench on the desk of somebody else: its checks run, its runs do not."""
    parts = {key: change.pop(key) for key in ("samples", "truth") & change.keys()}
    rig = change_yaml(
        small_rig(top=change), lambda r: [r["simulator"].setdefault(k, {}).update(v) for k, v in parts.items()]
    )
    code, out, err = acquire("--omega", 35, "--rig", rig, "--dry-run")
    assert code == 2
    assert f"REFUSED  {row}" in out
    assert "ok  disc" in out
    assert reason in err
    assert refused("--omega", 35, "--rig", rig)[0] == 2


def test_doctor_and_stop_do_without_who_is_called(acquire, small_rig):
    rig = small_rig(top={"alert": ["/no/such/program"]})
    code, out, _ = acquire("doctor", "--rig", rig)
    assert code == 1
    assert [line.split()[1] for line in out.splitlines() if "BAD" in line] == ["alert"]
    assert acquire("stop", "--rig", rig)[0] == 0


@pytest.mark.parametrize("option", [("--omega", 50), ("--plan", "p.yaml"), ("--resume", "c.h5"), ("--exposure", 1)])
def test_option_that_a_campaign_would_not_hear_is_refused(refused, configs, option):
    code, err = refused("--campaign", configs / "campaigns/red_sphere.yaml", *option)
    assert code == 2
    assert f"{option[0]} has no meaning with --campaign" in err


def test_next_command_can_be_pasted():
    path = Path("my captures/it's one.h5")
    for status, door in (("complete", "process"), ("aborted", "acquire")):
        words = shlex.split(next_command(Result(path, status, 44, 44)))
        assert (words[0], words[-1]) == (door, str(path))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--sample", "mirror"), ("nothing to measure", "--omega")),
        (("--omega", 181), ("181", "0 to 180")),
        (("--omega", 3), ("forbidden pose", "arm")),
        (("--omega", 35, "--wavelength", 500), ("500", "662")),
        (("--omega", 35, "--mode", "mueller"), ("mueller", "drr")),
        (("--omega", 35, "--sample", "gold"), ("gold", "red_sphere")),
        (("--omega", 35, "--sample", "air"), ("air", "180")),
        (("--omega", 35, "--exposure", 100), ("100", "exposure")),
        (("--omega", 35, "--exposure", -1), ("error: exposure_s must be a positive number",)),
        (("--omega", "nan"), ("omega_deg",)),
    ],
)
def test_plan_outside_what_the_rig_can_do(refused, small_rig, arguments, words):
    code, err = refused(*arguments, "--rig", small_rig())
    assert code == 2
    assert all(word in err for word in words), err


def test_a_file_is_no_folder_for_captures(acquire, small_rig, tmp_path):
    code, _, err = acquire("--omega", 35, "--rig", small_rig(), "--out", tmp_path / "one.h5")
    assert code == 2
    assert f"--out {tmp_path}" in err
    assert not (tmp_path / "one.h5").exists()


def test_states_that_do_not_determine_a_mueller_matrix(refused, small_rig, tmp_path):
    plan = tmp_path / "plan.yaml"
    plan.write_text("kind: plan\nstates: {kind: rotating_retarders, states: 40, step_deg: 9, ratio: 5}\n")
    code, err = refused("--plan", plan, "--rig", small_rig())
    assert code == 2
    assert "rank 12 of 16" in err


def test_nothing_asked_shows_help(acquire):
    code, out, _ = acquire()
    assert code == 2
    assert "--omega" in out
