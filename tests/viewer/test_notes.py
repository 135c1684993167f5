"""Notes, tags and groups of the list of files."""

import json
import re

import pytest

from acquisition.campaign.identity import IDENTITY

HERE = {"origin": "http://127.0.0.1:8000"}


def write(client, file="one.h5", **fields):
    return client.post("/note", json={"file": file, "text": "", "tags": ""} | fields, headers=HERE)


def test_a_note_and_tags_are_kept_shown_and_found(lab, client, drr_capture):
    drr_capture("one.h5")
    drr_capture("two.h5")
    assert write(client, text="the lamp was cold", tags=" Good, good , Good").json()["tags"] == ["Good", "good"]
    (note,) = json.loads((lab / ".umov-view/notes.json").read_text())["files"].items()
    assert note == ("one.h5", {"text": "the lamp was cold", "tags": ["Good", "good"]})
    page = client.get("/", params={"q": "COLD good"}).text
    assert "the lamp was cold" in page
    assert re.findall(r'capture\?file=([\w.]+)"', page) == ["one.h5"]
    assert "the lamp was cold" in client.get("/capture", params={"file": "one.h5"}).text
    # Empty again, nothing of it stays.
    write(client)
    assert json.loads((lab / ".umov-view/notes.json").read_text()) == {"files": {}}


def test_the_text_of_a_note_is_never_a_page_s_own(client, drr_capture):
    drr_capture("one.h5")
    write(client, text="<script>alert(1)</script>", tags="<b>")
    for page in (client.get("/").text, client.get("/capture", params={"file": "one.h5"}).text):
        assert "<script>alert" not in page
        assert "&lt;b&gt;" in page


@pytest.mark.parametrize(("fields", "code"), [({"file": "none.h5"}, 404), ({"text": "x" * 2001}, 422)])
def test_what_is_no_note_is_refused(lab, client, drr_capture, fields, code):
    drr_capture("one.h5")
    assert write(client, **fields).status_code == code
    assert not (lab / ".umov-view/notes.json").exists()


def test_captures_are_grouped_by_sample_and_by_campaign(lab, client, drr_capture):
    for folder in ("night", "other"):
        (lab / folder).mkdir()
    (lab / "night" / IDENTITY).write_text("{}")
    for name, sample in (("night/a.h5", "ball"), ("night/b.h5", "air"), ("other/c.h5", "ball"), ("d.h5", "air")):
        drr_capture(name, sample={"name": sample})

    def grouped(by, **more):
        text = client.get("/", params={"captures_group": by} | more).text
        return re.findall(r'scope="rowgroup">([^<]+)<|capture\?file=([\w%]+)\.h5"', text)

    order = {"captures_sort": "-name"}
    assert grouped("sample", **order) == [
        ("air (2)", ""), ("", "night%2Fb"), ("", "d"), ("ball (2)", ""), ("", "other%2Fc"), ("", "night%2Fa")
    ]  # fmt: skip
    assert grouped("campaign")[0] == ("night (2)", "")
    assert ("no campaign (2)", "") in grouped("campaign")
    assert all(not group for group, _ in grouped("beauty"))
