"""`process report`: one HTML file that needs nothing else, and tells simulated from measured."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser

from processing.commands.application import main
from processing.instrument.model import InstrumentModel
from processing.reduction.mueller import reduce_mueller
from processing.reports.report import collect
from processing.storage.captures.capture import Capture
from processing.storage.products.product import Step
from tests.commands import exit_code

VISIBLE = "n => n.checkVisibility({contentVisibilityAuto: true})"


def run(capsys: pytest.CaptureFixture[str], *args: object) -> tuple[int, str]:
    code = exit_code(main, *args)
    err = capsys.readouterr().err
    assert "Traceback" not in err
    return code, err


@pytest.fixture
def campaign(configs: Path, synthetic_capture, tmp_path: Path) -> Path:
    """A folder with a capture, its product, a table and a picture."""
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662)
    angles = {"psg": 9.0 * np.arange(40), "psa": 4.91 * 9.0 * np.arange(40)}
    frames = np.einsum("nck,k->nc", model.rows(angles), 900 * np.eye(4).reshape(16))
    frames = np.broadcast_to(frames[..., None, None], (40, 1, 8, 10)) + np.random.default_rng(1).normal(
        0, 1, (40, 1, 8, 10)
    )
    path = synthetic_capture(frames, angles, title="air <& mirror>", plan_yaml="kind: plan")
    with Capture(path) as capture:
        step = Step("reduce", {"capture": "capture.h5", "weighted": False})
        reduce_mueller(capture, model, tmp_path / "capture.mueller.h5", (step,))
    (tmp_path / "rmsd.csv").write_text("omega_deg,psi_deg\n10,1.5\n20,2.5\n", encoding="utf-8")
    (tmp_path / "curve.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg'/>", encoding="utf-8")
    return tmp_path


def test_report_is_self_contained(campaign: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = campaign / "report.html"
    code, err = run(capsys, "report", campaign, "--out", out, "--title", "Air & co")
    assert (code, err) == (0, "")
    text = out.read_text(encoding="utf-8")
    assert "SIMULATED" in text
    assert "<h1>Air &amp; co</h1>" in text
    assert "air &lt;&amp; mirror&gt;" in text
    # Nothing is fetched: every picture is inside, no script, no link but those within the page.
    sources = re.findall(r'src="([^"]{0,40})', text)
    assert len(sources) >= 4
    assert all(s.startswith("data:image/") for s in sources)
    assert all(h.startswith("#") for h in re.findall(r'href="([^"]*)"', text))
    assert "<script" not in text
    for expected in ("condition number", "7.14", "residual of the fit", "reduce(capture=capture.h5", "rmsd.csv", "2.5"):
        assert expected in text, expected
    assert "nothing was subtracted" in text
    # What `process mean --budget` prints, for the mean of the middle half.
    assert re.search(r"uncertainty budget of depolarization_index = (1\.000|0\.999)\d*", text)
    assert "noise of light and camera" in text
    assert "U95 = " in text


def test_the_same_command_makes_a_report_anew_and_another_does_not_replace_it(tmp_path: Path, capsys) -> None:
    (tmp_path / "rmsd.csv").write_text("omega_deg,psi_deg\n10,1.5\n20,2.5\n", encoding="utf-8")
    out = tmp_path / "report.html"
    assert run(capsys, "report", tmp_path, "--out", out, "--title", "Air & co") == (0, "")
    assert run(capsys, "report", tmp_path, "--out", out, "--title", "Air & co") == (0, "")
    code, err = run(capsys, "report", tmp_path, "--out", out)
    assert code == 2
    assert "exists" in err
    assert run(capsys, "report", tmp_path / "rmsd.csv", "--out", out, "--overwrite")[0] == 0


@pytest.mark.long
def test_a_report_on_paper_is_whole_and_has_nothing_to_press(campaign: Path, browser: Browser) -> None:
    out = campaign / "report.html"
    with pytest.raises(SystemExit):
        main(["report", str(campaign), "--out", str(out)])
    # A4 at 96 pixels an inch.
    page = browser.new_page(viewport={"width": 794, "height": 1123}, color_scheme="dark")
    page.goto(out.as_uri())
    folded = page.locator("details > pre").first
    assert not folded.evaluate(VISIBLE)
    page.emulate_media(media="print")
    assert folded.evaluate(VISIBLE)
    assert page.locator(".simulated").is_visible()
    assert page.locator("nav, button").evaluate_all("nodes => nodes.every(n => !n.checkVisibility())")
    assert page.evaluate("document.documentElement.scrollWidth") <= 794
    # Black on white, also where the screen is dark.
    body = page.locator("body")
    assert body.evaluate("n => getComputedStyle(n).backgroundColor") == "rgb(255, 255, 255)"
    assert body.evaluate("n => getComputedStyle(n).color") == "rgb(0, 0, 0)"
    assert page.pdf(format="A4").startswith(b"%PDF")


def test_files_are_in_the_order_that_they_were_made_in_whatever_their_time_stamps(campaign: Path) -> None:
    names = ["curve.svg", "rmsd.csv", "capture.h5", "capture.mueller.h5"]
    assert [path.name for path in collect([campaign])] == names
    os.utime(campaign / "capture.mueller.h5", (1e9, 1e9))
    assert [path.name for path in collect([campaign])] == names


def test_report_refuses_to_mix_and_to_be_empty(
    campaign: Path, synthetic_capture, capsys: pytest.CaptureFixture[str]
) -> None:
    synthetic_capture(np.ones((2, 1, 4, 4)), {}, name="real.h5", simulated=False)
    code, err = run(capsys, "report", campaign, "--out", campaign / "r.html")
    assert code == 2
    assert "never mixed" in err
    assert not (campaign / "r.html").exists()
    (campaign / "empty").mkdir()
    for source, message in (("empty", "nothing to report"), ("none", "no such file"), ("x.txt", "takes .h5")):
        (campaign / "x.txt").write_text("x", encoding="utf-8")
        code, err = run(capsys, "report", campaign / source, "--out", campaign / "r.html")
        assert code == 2
        assert message in err
