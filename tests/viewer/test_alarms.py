"""An alarm of the guard is on every page, and its button ends it, as the command does."""

import pytest
from starlette.testclient import TestClient

from acquisition.rig import alarms


@pytest.fixture
def alarm(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return alarms.give_alarm("bench <2>", "acquire died. THE LIGHT IS NOT SHUT: no answer")


def test_an_alarm_is_on_every_page_until_its_button_is_pressed(client: TestClient, alarm):
    for page in ("/", "/alarms"):
        shown = client.get(page).text
        assert "THE LIGHT IS NOT SHUT: no answer" in shown
        assert "bench &lt;2&gt;" in shown
        assert f'data-alarm="{alarm.name}"' in shown
    origin = {"Origin": "http://127.0.0.1:8000"}
    assert client.post("/acknowledge", json={"name": alarm.name}, headers=origin).status_code == 200
    # The guard that repeats it looks whether its file is there.
    assert not alarm.exists()
    assert "NOT SHUT" not in client.get("/").text
    assert client.post("/acknowledge", json={"name": alarm.name}, headers=origin).status_code == 404


@pytest.mark.parametrize("name", ["../other.json", "other.json", "", "/etc/passwd"])
def test_nothing_but_an_alarm_is_acknowledged(client: TestClient, alarm, name, tmp_path):
    unrelated = tmp_path / "umov" / "other.json"
    unrelated.write_text("{}")
    (tmp_path / "other.json").write_text("{}")
    answer = client.post("/acknowledge", json={"name": name}, headers={"Origin": "http://127.0.0.1:8000"})
    assert answer.status_code == 404
    assert unrelated.exists()
    assert (tmp_path / "other.json").exists()
    assert alarm.exists()


def test_a_page_of_another_site_cannot_acknowledge(client: TestClient, alarm):
    for headers in ({}, {"Origin": "http://elsewhere.example"}):
        assert client.post("/acknowledge", json={"name": alarm.name}, headers=headers).status_code == 403
    assert alarm.exists()
