"""What is decided about a diagnosis is kept, and nothing that is there is ever replaced."""

import json

import pytest

from processing.diagnosis.search.result import Correction, Diagnosis, Error
from processing.instrument.model import AppliedEffect, InstrumentModel
from viewer.diagnoses import Diagnoses
from viewer.library import Library, NotHere

ORIGIN = {"origin": "http://127.0.0.1:8000"}


@pytest.fixture
def diagnosed(lab, drr_capture):
    """A diagnosis that has found a rotated analyzer, as its command would have left it; returns its name."""
    diagnoses = Diagnoses(Library(lab))
    name, folder = diagnoses.begin([drr_capture("one.h5")], None)
    error = Error(rms_percent=2.0, chi2_reduced=1.5, held_out="every other tile")
    effect = AppliedEffect.model_validate(
        {"kind": "psa_azimuth", "element": "psa_retarder", "parameters": {"azimuth": {"value": 0.5, "unit": "degree"}}}
    )
    found = Diagnosis(
        verdict="explained",
        error_before=error,
        error_after=error,
        noise_floor_percent=None,
        effects=(),
        unobservable=(),
        recommendation="Capture <b>air</b>.",
        unexplained=None,
        calibrated={},
        ranking=(),
        captures=(),
        instrument="RGB950",
        wavelengths_nm=(662.0,),
        simulated=True,
        correction=Correction(effects=(effect,)),
    )
    (folder / "diagnosis.json").write_text(found.model_dump_json())
    return name


def test_the_page_tells_the_verdict_and_proposes_a_free_name(lab, client, diagnosed):
    (lab / "RGB950_2.yaml").write_text("taken")
    page = client.get("/diagnosis", params={"name": diagnosed}).text
    assert "RGB950: explained" in page
    assert 'value="RGB950_3.yaml"' in page
    assert "Capture &lt;b&gt;air" in page
    assert "SIMULATED" in page
    assert diagnosed in client.get("/capture", params={"file": "one.h5"}).text


def test_an_accepted_model_is_a_new_file_with_its_note(lab, client, diagnosed):
    (lab / "taken.yaml").write_text("mine")
    asked = {"name": diagnosed, "accept": "yes", "file": "taken.yaml", "note": "seen\nat the bench"}
    taken = client.post("/decide", json=asked, headers=ORIGIN)
    assert (taken.status_code, "never replaces a file" in taken.text) == (422, True)
    assert (lab / "taken.yaml").read_text() == "mine"
    asked["file"] = "new.yaml"
    assert client.post("/decide", json=asked, headers=ORIGIN).json() == {"file": "new.yaml"}
    text = (lab / "new.yaml").read_text()
    assert "# seen\n# at the bench\n" in text
    assert [effect.kind for effect in InstrumentModel.load(lab / "new.yaml").effects] == ["psa_azimuth"]
    assert "Accepted on" in client.get("/diagnosis", params={"name": diagnosed}).text


@pytest.mark.parametrize("later", [{"accept": "yes", "file": "other.yaml"}, {}])
def test_what_one_tab_has_decided_no_other_changes(lab, client, diagnosed, later):
    client.post("/decide", json={"name": diagnosed, "accept": "yes", "file": "new.yaml"}, headers=ORIGIN)
    again = client.post("/decide", json={"name": diagnosed} | later, headers=ORIGIN)
    assert (again.status_code, "decided already" in again.text) == (422, True)
    assert not (lab / "other.yaml").exists()
    assert "as <code>new.yaml" in client.get("/diagnosis", params={"name": diagnosed}).text


def test_a_rejected_model_leaves_its_note_and_no_file(lab, client, diagnosed):
    before = set(lab.iterdir())
    answer = client.post("/decide", json={"name": diagnosed, "note": "the lamp was cold"}, headers=ORIGIN)
    assert answer.json() == {"file": None}
    page = client.get("/diagnosis", params={"name": diagnosed}).text
    assert "Not accepted" in page
    assert "the lamp was cold" in page
    assert set(lab.iterdir()) == before


@pytest.mark.parametrize("file", ["../new.yaml", "/tmp/new.yaml", ".new.yaml", "new.h5", "", "a/b.yaml"])
def test_a_model_goes_nowhere_else(lab, client, diagnosed, file):
    asked = {"name": diagnosed, "accept": "yes", "file": file, "note": ""}
    answer = client.post("/decide", json=asked, headers=ORIGIN)
    assert (answer.status_code, "plain file name" in answer.text) == (422, True)


def test_a_diagnosis_begins_with_a_copy_of_its_model(lab, diagnosed, configs):
    diagnoses = Diagnoses(Library(lab))
    model = InstrumentModel.load(diagnoses.folder(diagnosed) / "instrument.yaml")
    assert model.name == "RGB950"
    assert json.loads((diagnoses.folder(diagnosed) / "about.json").read_text())["captures"] == ["one.h5"]
    with pytest.raises(NotHere):
        diagnoses.folder("../jobs")


def test_a_diagnosis_that_cannot_be_read_takes_no_other_page_away(lab, client, diagnosed):
    (Diagnoses(Library(lab)).folder(diagnosed) / "diagnosis.json").write_text('{"verdict": "of another version"}')
    answer = client.get("/diagnosis", params={"name": diagnosed})
    assert (answer.status_code, "diagnose anew" in answer.text) == (422, True)
    assert client.get("/capture", params={"file": "one.h5"}).status_code == 200


def test_a_report_that_is_not_there_is_said_to_be_missing(client, diagnosed):
    assert client.get("/diagnosis-report", params={"name": diagnosed}).status_code == 404
