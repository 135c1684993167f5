"""What is decided about a diagnosis is kept, and nothing that is there is ever replaced."""

import json

import pytest

from processing.diagnosis.search.result import Correction, Diagnosis, Error, FoundEffect
from processing.diagnosis.surface.diagnose import SurfaceDiagnosis
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import AppliedEffect, InstrumentModel
from processing.reflectance.base import load_reflectance
from viewer.diagnoses import Diagnoses
from viewer.library import Library, NotHere

ORIGIN = {"origin": "http://127.0.0.1:8000"}
ERROR = Error(rms_percent=2.0, chi2_reduced=1.5, held_out="every other tile")
#: What every verdict here says.
FOUND = {
    "verdict": "explained",
    "error_before": ERROR,
    "error_after": ERROR,
    "noise_floor_percent": None,
    "unobservable": (),
    "unexplained": None,
    "calibrated": {},
    "ranking": (),
    "captures": (),
    "instrument": "RGB950",
    "wavelengths_nm": (662.0,),
    "simulated": True,
}


@pytest.fixture
def diagnosed(lab, drr_capture):
    """A diagnosis that has found a rotated analyzer, as its command would have left it; returns its name."""
    diagnoses = Diagnoses(Library(lab))
    name, folder = diagnoses.begin([drr_capture("one.h5")], None)
    effect = AppliedEffect.model_validate(
        {"kind": "psa_azimuth", "element": "psa_retarder", "parameters": {"azimuth": {"value": 0.5, "unit": "degree"}}}
    )
    diagnosis = Diagnosis(
        **FOUND, effects=(), recommendation="Capture <b>air</b>.", correction=Correction(effects=(effect,))
    )
    (folder / "diagnosis.json").write_text(diagnosis.model_dump_json())
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
    decision = {"name": diagnosed, "accept": "yes", "file": "taken.yaml", "note": "seen\nat the bench"}
    answer = client.post("/decide", json=decision, headers=ORIGIN)
    assert (answer.status_code, "is not replaced" in answer.text) == (422, True)
    assert (lab / "taken.yaml").read_text() == "mine"
    decision["file"] = "new.yaml"
    assert client.post("/decide", json=decision, headers=ORIGIN).json() == {"files": ["new.yaml"]}
    text = (lab / "new.yaml").read_text()
    assert "# seen\n# at the bench\n" in text
    assert [effect.kind for effect in InstrumentModel.load(lab / "new.yaml").effects] == ["psa_azimuth"]
    assert "Accepted on" in client.get("/diagnosis", params={"name": diagnosed}).text


@pytest.mark.parametrize("later", [{"accept": "yes", "file": "other.yaml"}, {}])
def test_what_one_tab_has_decided_no_other_changes(lab, client, diagnosed, later):
    client.post("/decide", json={"name": diagnosed, "accept": "yes", "file": "new.yaml"}, headers=ORIGIN)
    answer = client.post("/decide", json={"name": diagnosed} | later, headers=ORIGIN)
    assert (answer.status_code, "decided already" in answer.text) == (422, True)
    assert not (lab / "other.yaml").exists()
    assert "as <code>new.yaml" in client.get("/diagnosis", params={"name": diagnosed}).text


def test_a_link_in_the_place_of_a_decision_is_not_followed(lab, diagnosed, tmp_path):
    link = Diagnoses(Library(lab)).folder(diagnosed) / "decision.json"
    link.symlink_to(tmp_path / "elsewhere")
    Diagnoses(Library(lab)).reject(diagnosed, "no")
    assert not (tmp_path / "elsewhere").exists()
    assert json.loads(link.read_text())["note"] == "no"


def test_a_rejected_model_leaves_its_note_and_no_file(lab, client, diagnosed):
    before = set(lab.iterdir())
    answer = client.post("/decide", json={"name": diagnosed, "note": "the lamp was cold"}, headers=ORIGIN)
    assert answer.json() == {"files": []}
    page = client.get("/diagnosis", params={"name": diagnosed}).text
    assert "Not accepted" in page
    assert "the lamp was cold" in page
    assert set(lab.iterdir()) == before


@pytest.mark.parametrize("file", ["../new.yaml", "/tmp/new.yaml", ".new.yaml", "new.h5", "", "a/b.yaml"])
def test_a_model_goes_nowhere_else(lab, client, diagnosed, file):
    decision = {"name": diagnosed, "accept": "yes", "file": file, "note": ""}
    answer = client.post("/decide", json=decision, headers=ORIGIN)
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
    assert (answer.status_code, "run the diagnosis again" in answer.text) == (422, True)
    assert client.get("/capture", params={"file": "one.h5"}).status_code == 200


def test_a_report_that_is_not_there_is_said_to_be_missing(client, diagnosed):
    assert client.get("/diagnosis-report", params={"name": diagnosed}).status_code == 404


@pytest.fixture
def surface_diagnosed(lab, drr_capture, configs):
    """A diagnosis that has found other constants of the material and a zero of the arm; returns its name."""
    diagnoses = Diagnoses(Library(lab))
    surface = (configs / "materials/red_print.yaml", configs / "geometries/one_inch_sphere.yaml")
    name, folder = diagnoses.begin([drr_capture("one.h5")], None, surface)
    common = {"evidence": 900.0, "indistinguishable_from": (), "scope": "instrument", "removal_chance": 0.0}
    arm = {"arm": {"value": 0.7, "unit": "degree"}}
    effects = (
        FoundEffect(kind="arm_zero", element=None, parameters=arm, confident=True, **common),
        FoundEffect(kind="refractive_index", element=None, parameters={}, confident=True, **common),
    )
    applied = tuple(AppliedEffect(kind=e.kind, parameters=e.parameters) for e in effects)
    diagnosis = SurfaceDiagnosis(
        **FOUND,
        effects=effects,
        correction=Correction(effects=applied),
        recommendation="",
        material="red 3D print",
        constants={"n": 1.4, "k": 0.1, "a": 0.2, "b": 2.0},
        quantities_before=(),
        quantities_after=(),
        xi0_change=(),
    )
    (folder / "diagnosis.json").write_text(diagnosis.model_dump_json())
    return name


def test_an_accepted_surface_is_a_new_material_and_a_new_geometry(lab, client, surface_diagnosed, configs):
    page = client.get("/diagnosis", params={"name": surface_diagnosed}).text
    assert "red 3D print: explained" in page
    assert "disagree with the material on its geometry" in page
    assert 'value="red_3D_print_2.yaml"' in page
    decision = {"name": surface_diagnosed, "accept": "yes", "file": "print.yaml", "note": "looked at twice"}
    assert client.post("/decide", json=decision, headers=ORIGIN).json() == {
        "files": ["print.yaml", "print.geometry.yaml"]
    }
    for file in ("print.yaml", "print.geometry.yaml"):
        assert "# looked at twice\n" in (lab / file).read_text()
        assert f"<code>{file}</code>" in client.get("/diagnosis", params={"name": surface_diagnosed}).text
    constants = load_reflectance(lab / "print.yaml").constants
    assert (constants[662].n, constants[451].n) == (1.4, 1.2)
    assert ViewingGeometry.load(lab / "print.geometry.yaml").arm_zero_deg == 0.7
    page = client.get("/capture", params={"file": "one.h5"}).text
    assert "<option>print.yaml</option>" in page
    assert "<option>print.geometry.yaml</option>" in page


def test_a_surface_whose_correction_is_refused_is_not_written(lab, client, surface_diagnosed):
    result = Diagnoses(Library(lab)).folder(surface_diagnosed) / "diagnosis.json"
    document = json.loads(result.read_text())
    document["correction"]["refused"] = "it would make worse: rms: 1 to 2"
    result.write_text(json.dumps(document))
    assert not Diagnoses(Library(lab)).story(surface_diagnosed).writes
    decision = {"name": surface_diagnosed, "accept": "yes", "file": "print.yaml", "note": ""}
    answer = client.post("/decide", json=decision, headers=ORIGIN)
    assert (answer.status_code, "it would make worse" in answer.text) == (422, True)
    assert not list(lab.glob("print*"))


def test_nothing_of_an_accepted_surface_replaces_a_file(lab, client, surface_diagnosed):
    (lab / "print.geometry.yaml").write_text("mine")
    decision = {"name": surface_diagnosed, "accept": "yes", "file": "print.yaml", "note": ""}
    answer = client.post("/decide", json=decision, headers=ORIGIN)
    assert (answer.status_code, "is not replaced" in answer.text) == (422, True)
    assert (lab / "print.geometry.yaml").read_text() == "mine"
    assert not (lab / "print.yaml").exists()
    assert "Believe it?" in client.get("/diagnosis", params={"name": surface_diagnosed}).text
