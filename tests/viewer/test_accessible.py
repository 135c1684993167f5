"""Every page has no finding of axe-core, at the width of a desk and of a phone; logs scroll by keys."""

import json

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import expect

from acquisition.campaign.identity import IDENTITY
from acquisition.rig import alarms
from processing.commands.diagnose import main as diagnose
from processing.steps.maps import Quantities
from processing.steps.reduction import Reduction
from viewer.diagnoses import Diagnoses
from viewer.jobs import Jobs
from viewer.library import Library

#: What is checked: everything that axe knows of the levels A and AA, and its best practice.
RULES = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]}


@pytest.fixture
def campaign(lab, drr_capture):
    """Address of the page of a campaign with one capture."""
    (lab / "night").mkdir()
    (lab / "night" / IDENTITY).write_text(json.dumps({"campaign": {}, "simulated": True}))
    drr_capture("night/air.h5")
    return "/campaign?folder=night"


@pytest.fixture
def pages(lab, drr_capture, client, campaign, diagnosed, monkeypatch, tmp_path):
    """Address of each page of a folder with captures, products, a campaign, regions, notes, a job and an alarm."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    alarms.give_alarm("bench", "acquire died. THE LIGHT IS NOT SHUT: no answer")
    first, second = drr_capture("one.h5", omega_deg=35.0), drr_capture("two.h5", seed_of_noise=2)
    products = [Reduction(first).make(), Reduction(second).make()]
    Quantities(products[0]).make()
    (lab / "damaged.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    origin = {"origin": "http://127.0.0.1:8000"}
    place = {"x0": "2", "x1": "9", "y0": "3", "y1": "8"}
    for name in ("spot", "edge"):
        assert client.post("/keep-region", json={"file": "one.h5", "name": name} | place, headers=origin).is_success
    assert client.post("/note", json={"file": "one.h5", "text": "cold", "tags": "a, b"}, headers=origin).is_success
    job = Jobs(lab).start("long output", ["process", "--help"], {}, lab)
    return {
        "library": "/?captures_group=sample",
        "search": "/?q=cold",
        "capture": "/capture?file=one.h5#x=5&y=4",
        "mueller": "/product?file=one.mueller.h5#x=5&y=4",
        "quantities": "/product?file=one.quantities.h5#x=5&y=4",
        "compare": "/compare?a=one.mueller.h5&b=two.mueller.h5",
        "campaign": campaign,
        "stack": "/stack",
        "diagnosis": f"/diagnosis?name={diagnosed}",
        "report": f"/diagnosis-report?name={diagnosed}",
        "refused": "/capture?file=none.h5",
        "job": f"/job?name={job.name}",
    }


@pytest.fixture
def diagnosed(lab, drr_capture, configs, run_main):
    """A diagnosis against a file whose plate has another retardance, as the button leaves it; returns its name."""
    capture = drr_capture("air.h5", sample={"kind": "air"}, mueller=np.eye(4))
    text = (configs / "instruments/rgb950.yaml").read_text()
    (lab / "off.yaml").write_text(text.replace("662: 127.12", "662: 128.9"))
    name, folder = Diagnoses(Library(lab)).begin([capture], lab / "off.yaml")
    outputs = ("--json", folder / "diagnosis.json", "--report", folder / "report.html")
    options = ("--instrument", folder / "instrument.yaml", "--residuals", folder / "residuals.npz")
    assert run_main(diagnose, capture, *options, *outputs)[0] == 0
    return name


def findings(page):
    violations = Axe().run(page, options=RULES).response["violations"]
    return [(violation["id"], [node["html"][:150] for node in violation["nodes"]]) for violation in violations]


@pytest.mark.long
def test_no_page_has_a_finding_and_none_is_wider_than_its_window(pages, address, browser):
    wrong = {}
    for width in (1400, 380):
        page = browser.new_page(viewport={"width": width, "height": 900})
        page.set_default_timeout(60_000)
        for name, where in pages.items():
            page.goto(f"{address}{where}", wait_until="load")
            if "#" in where:
                page.locator("body[data-ready]").wait_for()
                page.locator("#region-histogram .plot-container").wait_for()
                page.locator("#probe:not([hidden])").wait_for()
            page.wait_for_timeout(300)
            if violations := findings(page):
                wrong[name, width] = violations
            assert page.evaluate("document.documentElement.scrollWidth") <= width, (name, width)
        page.close()
    assert wrong == {}, wrong


@pytest.mark.long
def test_a_log_scrolls_by_keys(campaign, address, browser):
    page = browser.new_page(viewport={"width": 1400, "height": 500})
    page.goto(f"{address}{campaign}")
    log = page.locator("#log")
    log.evaluate("node => { for (let k = 0; k < 99; k++) node.append(`line ${k}`, document.createElement('br')); }")
    log.focus()
    expect(log).to_be_focused()
    page.keyboard.press("End")
    # A page's own policy forbids the tests to wait for an expression.
    page.wait_for_timeout(500)
    assert log.evaluate("node => node.scrollTop") > 0
