"""Only a browser on this machine that was given the whole address is answered, and no page of another site."""

import json
import os
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from viewer.application import application

TOKEN = "the-token"
HERE = {"origin": "http://127.0.0.1:8000"}
ADDRESSES = ("/", "/style.css", "/static/plots.js", "/capture?file=one.h5", "/frame?file=one.h5", "/events?folder=.")


def browser(lab, **more):
    return TestClient(application(lab, TOKEN), base_url="http://127.0.0.1:8000", raise_server_exceptions=False, **more)


@pytest.mark.parametrize("address", ADDRESSES)
@pytest.mark.parametrize("token", ["", "/wrong", f"/{TOKEN}x", f"/x/{TOKEN}"])
def test_without_the_token_nothing_is_answered(lab, address, token):
    answer = browser(lab).get(token + address)
    assert answer.status_code == 403
    assert TOKEN not in answer.text


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example:8000", "localhost.evil:8000", ""])
def test_a_name_of_another_site_is_refused(lab, host):
    assert browser(lab).get(f"/{TOKEN}/", headers={"host": host}).status_code == 403


@pytest.mark.parametrize("host", ["127.0.0.1:8000", "localhost:9000", "localhost"])
def test_this_machine_is_let_in_also_through_a_tunnel(lab, host):
    assert browser(lab).get(f"/{TOKEN}/", headers={"host": host}).status_code == 200


@pytest.mark.parametrize("origin", [None, "http://evil.example", "http://127.0.0.1:9999", "http://[", "null"])
def test_no_other_page_changes_anything(lab, origin):
    headers = {} if origin is None else {"origin": origin}
    assert browser(lab).post(f"/{TOKEN}/stop", headers=headers).status_code == 403


def test_our_own_page_may_ask_and_is_told_what_is_wrong(lab):
    (lab / "night").mkdir()
    headers = {"origin": "http://127.0.0.1:8000"}
    answer = browser(lab).post(f"/{TOKEN}/stop", headers=headers, json={"folder": "night"})
    assert (answer.status_code, answer.text) == (422, "no run is active in this folder")


def test_pages_take_nothing_from_elsewhere_and_tell_nobody_where_they_are(lab):
    headers = browser(lab).get(f"/{TOKEN}/").headers
    assert "default-src 'none'" in headers["content-security-policy"]
    assert "unsafe-inline" not in headers["content-security-policy"].split("script-src")[1].split(";")[0]
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["cache-control"] == "no-store"


@pytest.mark.parametrize(
    "name", ["../secret.h5", "/etc/passwd", "link.h5", "loop.h5", "nothing.h5", "one.h5\0", "x" * 300]
)
def test_nothing_outside_the_folder_is_read(lab, name):
    (lab.parent / "secret.h5").write_bytes(b"secret")
    (lab / "link.h5").symlink_to(lab.parent / "secret.h5")
    (lab / "loop.h5").symlink_to("loop.h5")
    for page in ("capture", "frame", "histogram", "curve"):
        answer = browser(lab).get(f"/{TOKEN}/{page}", params={"file": name})
        assert answer.status_code == 404
        assert "HDF5" not in answer.text


def test_links_that_lead_out_or_nowhere_are_not_listed(lab):
    (lab.parent / "secret.h5").write_bytes(b"secret")
    (lab.parent / "secret.yaml").write_text("kind: campaign\n")
    for name, target in (("out.h5", "../secret.h5"), ("out.yaml", "../secret.yaml"), ("gone.yaml", "nothing.yaml")):
        (lab / name).symlink_to(target)
    answer = browser(lab).get(f"/{TOKEN}/")
    assert answer.status_code == 200
    assert "out." not in answer.text
    assert "gone.yaml" not in answer.text


def test_a_campaign_that_names_files_elsewhere_shows_none_of_them(lab):
    (lab.parent / "secret.h5").write_bytes(b"secret")
    (lab / "night").mkdir()
    (lab / "night" / "identity.json").write_text('{"plan": {"../../secret.h5": {}}}')
    answer = browser(lab).get(f"/{TOKEN}/campaign", params={"folder": "night"})
    assert answer.status_code == 200
    assert "0 of 1" in answer.text
    assert "file=" not in answer.text


def test_a_name_is_text_of_the_page_and_nothing_else(lab):
    (lab / "<img src=x onerror=alert(1)>.h5").write_bytes(b"no HDF5")
    (Path(os.fsdecode(os.fsencode(lab) + b"/m\xfcde.h5"))).write_bytes(b"no HDF5")
    page = browser(lab).get(f"/{TOKEN}/")
    assert page.status_code == 200
    assert "<img src=x" not in page.text
    assert "its name is not UTF-8" in page.text


def test_a_campaign_of_somebody_else_is_not_resumed_from_the_page(client, lab, tmp_path, monkeypatch, configs):
    """Neither the rig file nor the campaign file that a data folder names is opened or run."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    night = lab / "night"
    night.mkdir()
    (night / "identity.json").write_text(json.dumps({"rig_file": str(tmp_path / "evil.yaml"), "plan": {"a.h5": {}}}))
    answer = client.post("/start", json={"what": "resume", "folder": "night"}, headers=HERE)
    assert answer.status_code == 422
    assert "was not begun by you" in answer.text
    campaign = (configs / "campaigns" / "red_sphere.yaml").read_text()
    (lab / "c.yaml").write_text(campaign.replace("kind: campaign", f"kind: campaign\nrig: {tmp_path / 'evil.yaml'}"))
    answer = client.post("/start", json={"what": "campaign", "file": "c.yaml"}, headers=HERE)
    assert answer.status_code == 422
    assert "which you have not used before" in answer.text
    assert not (lab / ".umov").exists() or not list((lab / ".umov").glob("jobs/*"))


def test_a_body_that_is_too_large_is_refused_before_it_is_kept(client):
    answer = client.post("/start", content=(b"x" * (1 << 16) for _ in range(1000)), headers=HERE)
    assert answer.status_code == 422
    assert "at most" in answer.text


def test_the_token_is_not_on_the_command_line_of_the_browser(monkeypatch):
    from viewer import server

    opened = []
    monkeypatch.setattr(server.webbrowser, "open", opened.append)
    page = server.open_in_browser(f"http://127.0.0.1:1/{TOKEN}/")
    assert opened == [page.as_uri()]
    assert TOKEN not in opened[0]
    assert TOKEN in page.read_text()
    assert page.stat().st_mode & 0o077 == 0
    page.unlink()
