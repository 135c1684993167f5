"""A whole evening in a real browser: start a campaign, watch, stop, resume, look, diagnose, accept, compare.

With UMOV_SCREENSHOTS=FOLDER the pictures of docs/view.md are written there.
"""

import json
import os
import re
import shutil
import urllib.parse
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image
from playwright.sync_api import ConsoleMessage, Page, Route, expect
from ruamel.yaml import YAML

from acquisition.rig.alarms import give_alarm
from acquisition.rig.own_rigs import note_rig

#: However long a busy machine takes; the limit of a test ends a hang.
PATIENCE_MS = 300_000


#: Where everything that a page loads must come from.
LOCAL = re.compile(r"http://127\.0\.0\.1:|data:|blob:|about:")


def complains(message: ConsoleMessage) -> bool:
    """Whether a page complains; an answer of 4xx is part of the test."""
    return message.type == "error" and "status of 4" not in message.text


@pytest.fixture
def lab(small_rig, configs, tmp_path) -> Path:
    """A folder with a rig whose analyzer has a wedge that nobody declared, a long campaign, and a broken file."""
    folder = tmp_path / "lab"
    folder.mkdir()
    wedge = [{"kind": "image_drift", "axis": "psa", "wedge_pixels": 0.4}]
    shutil.move(small_rig(effects=wedge, rows=120, columns=120, clock_speed=20), folder / "rig.yaml")
    # As a command in a terminal does: a page starts nothing with a rig file that was not used before.
    note_rig(folder / "rig.yaml", "simulated RGB950")
    campaign = {
        "kind": "campaign",
        "name": "evening",
        "rig": "rig.yaml",
        "plans": {"drr": str(configs / "plans" / "drr.yaml")},
        "samples": [{"name": "red_sphere"}],
        "wavelengths_nm": [662],
        # Longer than anything that looks at it needs.
        "omega_deg": {"start": 35, "stop": 85, "step": 2},
    }
    with (folder / "evening.yaml").open("w") as file:
        YAML().dump(campaign, file)
    (folder / "broken.h5").write_bytes(b"\x89HDF\r\n\x1a\n and nothing more")
    return folder


@pytest.fixture
def window(browser):
    """A function that opens a tab; what a page complains of fails the test."""
    wrong: list[str] = []
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    context.set_default_timeout(PATIENCE_MS)
    expect.set_options(timeout=PATIENCE_MS)

    def tab() -> Page:
        page = context.new_page()
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda message: wrong.append(message.text) if complains(message) else None)
        page.on("request", lambda request: None if LOCAL.match(request.url) else wrong.append(request.url))
        return page

    yield tab
    context.close()
    assert wrong == []


def keep(page: Page, name: str) -> None:
    """A picture for the docs, where they are wanted."""
    if folder := os.environ.get("UMOV_SCREENSHOTS"):
        page.wait_for_timeout(600)
        path = Path(folder) / f"view_{name}.png"
        page.screenshot(path=path, full_page=True)
        # A page has few colours: a third of the bytes.
        Image.open(path).convert("RGB").quantize(192).save(path, optimize=True)


def ready(page: Page) -> None:
    """Wait until the page's own script has drawn what it draws."""
    expect(page.locator("body[data-ready]")).to_be_attached()


def fits(page: Page) -> bool:
    """Nothing is wider than the window."""
    return bool(page.evaluate("document.documentElement.scrollWidth <= innerWidth"))


@pytest.mark.long
def test_a_button_waits_for_its_script(address, window):
    page = window()
    held: list[Route] = []
    script = "**/static/start.js"
    page.route(script, lambda route: held.append(route))
    with page.expect_request(script):
        page.goto(f"{address}/", wait_until="commit")
    # Sent before the script has come, the form would leave the page and start nothing.
    expect(page.get_by_role("button", name="Start")).to_be_disabled()
    held[0].continue_()
    expect(page.get_by_role("button", name="Start")).to_be_enabled()


@pytest.fixture
def own_alarms(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.mark.long
def test_an_alarm_that_comes_while_a_page_is_open_is_shown_and_acknowledged(own_alarms, address, window):
    page = window()
    page.goto(f"{address}/")
    expect(page.get_by_role("button", name="Start")).to_be_enabled()
    alarm = give_alarm("bench", "THE LIGHT IS NOT SHUT")
    expect(page.get_by_role("alert")).to_contain_text("THE LIGHT IS NOT SHUT")
    page.get_by_role("button", name="Acknowledge").click()
    expect(page.get_by_role("alert")).to_have_count(0)
    assert not alarm.exists()


@pytest.mark.long
def test_a_whole_evening(lab, address, window, draw_region):
    page = window()
    page.goto(f"{address}/")
    expect(page.get_by_text("cannot be opened as HDF5")).to_be_visible()

    _start_watch_stop_resume(page, window(), lab, address)
    capture = "evening/001_red_sphere_drr_662nm_omega35.h5"
    _look_and_probe(page, address, capture, draw_region)
    _diagnose_and_accept(page, lab)
    _compare_before_and_after(page, lab, address, capture)
    _narrow_and_dark(page, address, capture)


def _start_watch_stop_resume(page: Page, second: Page, lab: Path, address: str) -> None:
    page.get_by_label("Start a campaign").select_option("evening.yaml")
    page.get_by_role("button", name="Start").click()
    page.get_by_role("link", name="The campaign").click()
    expect(page.locator("#captures")).to_have_text(re.compile(r"\d+ of 26"))
    expect(page.locator("#states")).to_have_text(re.compile(r"([6-9]|[1-4]\d) of 44"))
    degrees = [float(text.rstrip("°")) for text in page.locator("#axes td").all_text_contents()]
    assert len(degrees) == 3
    assert all(0 <= angle < 360 for angle in degrees)

    # Another tab sees the same, and the capture that is being written.
    second.goto(page.url)
    expect(second.locator("#captures")).to_have_text(re.compile(r"\d+ of 26"))
    expect(second.locator("#lampwords")).to_have_text(re.compile("dark-corrected mean of each state"))
    expect(second.locator("#frame .nsewdrag")).to_be_attached()
    # What has ended is told there without loading the page anew: sign with its link, bar and log.
    expect(second.locator("a.cell.done").first).to_be_attached()
    expect(second.locator("#log")).to_contain_text("capture ended: 001_")
    expect(second.locator("#timeline")).to_contain_text("001_")
    keep(second, "campaign")
    partial = next((lab / "evening").glob("*.partial"), None)
    if partial is not None:
        second.goto(f"{address}/capture?{urllib.parse.urlencode({'file': f'evening/{partial.name}'})}")

    page.get_by_role("button", name="Stop").click()
    expect(page.locator("#run")).to_be_hidden()
    _ended(lab)
    expect(page.locator("#resume")).to_be_visible()
    page.get_by_role("button", name="Take what is missing").click()
    page.set_viewport_size({"width": 390, "height": 844})
    expect(page.get_by_role("link", name="The campaign")).to_be_visible()
    assert fits(page)
    page.set_viewport_size({"width": 1280, "height": 900})
    expect(page.locator(".simulated")).to_be_visible()
    page.get_by_role("link", name="The campaign").click()
    expect(page.locator(".cell.done").first).to_be_attached()
    page.get_by_role("button", name="Stop").click()
    expect(page.locator("#run")).to_be_hidden()
    _ended(lab)
    # The page loads anew when the run has ended, and would take the next one away.
    expect(page.locator("#resume")).to_be_visible()
    statuses = [entry["status"] for entry in json.loads((lab / "evening" / "index.json").read_text()).values()]
    assert statuses[0] == "complete"
    assert "failed" not in statuses
    second.close()


def _ended(lab: Path) -> None:
    """Every job that took captures has ended as Ctrl-C ends it."""
    codes = {path.read_text() for path in lab.glob(".umov-view/jobs/*/code")}
    assert codes <= {"130"}, codes


def _look_and_probe(page: Page, address: str, capture: str, draw_region: Callable[..., None]) -> None:
    page.goto(f"{address}/?q=omega+35+complete")
    page.get_by_role("link", name=capture).click()
    ready(page)
    first = page.locator("#which").text_content()
    page.keyboard.press(".")
    expect(page.locator("#which")).not_to_have_text(first or "")
    page.locator("#frame").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowDown")
    expect(page.locator("#pixel")).to_have_text("column 61, row 61")
    expect(page.locator("#probe .matrix small")).to_have_count(16)
    expect(page.locator("#probe")).to_contain_text("coherency eigenvalues")
    # A click on a pixel does what the keys do, a drawn rectangle gives the mean of many.
    box = page.locator("#frame .nsewdrag").first.bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + box["width"] * 0.55, box["y"] + box["height"] * 0.45)
    expect(page.locator("#pixel")).to_have_text(re.compile(r"column 6\d, row 5\d"))
    keep(page, "capture")
    draw_region(page, (0.5, 0.4), (0.6, 0.5))
    scale = page.locator("#frame .cbaxis")
    # A capture opens stretched: its light ends well below the full scale.
    expect(scale).not_to_contain_text("4000")
    stretched = scale.text_content() or ""
    page.get_by_label("stretch").uncheck()
    expect(scale).not_to_have_text(stretched)
    page.get_by_role("button", name="Play").click()
    expect(page.get_by_role("button", name="Pause")).to_be_visible()
    page.get_by_role("button", name="Pause").click()


def _diagnose_and_accept(page: Page, lab: Path) -> None:
    page.get_by_role("button", name="Diagnose").click()
    expect(page.locator("#output")).to_contain_text("residual beyond noise")
    page.get_by_role("link", name="The verdict").click()
    ready(page)
    expect(page.locator("h1")).to_contain_text("explained")
    expect(page.get_by_role("heading", name="beam wander")).to_be_visible()
    states = page.locator("#states .nsewdrag").first.bounding_box()
    assert states is not None
    expect(page.locator("#before .nsewdrag")).to_be_attached()
    keep(page, "diagnosis")
    page.get_by_label("Note").fill("wedge seen at the bench\nwith a laser")
    page.get_by_label("New instrument file").fill("evening.yaml")
    page.get_by_role("button", name="Accept", exact=True).click()
    # A name that is taken is never written over.
    expect(page.locator("#answer")).to_contain_text("exists and is not replaced")
    page.get_by_label("New instrument file").fill("with_wedge.yaml")
    page.get_by_role("button", name="Accept", exact=True).click()
    expect(page.get_by_text("Accepted on")).to_be_visible()
    text = (lab / "with_wedge.yaml").read_text()
    assert "# wedge seen at the bench\n# with a laser\n" in text
    assert "kind: beam_wander" in text
    page.get_by_role("button", name="Reduce").click()
    expect(page.locator("#status")).to_have_text("done")


def _compare_before_and_after(page: Page, lab: Path, address: str, capture: str) -> None:
    page.goto(f"{address}/capture?{urllib.parse.urlencode({'file': capture})}")
    page.get_by_role("button", name="Reduce").click()
    expect(page.locator("#status")).to_have_text("done")
    page.goto(f"{address}/product?{urllib.parse.urlencode({'file': capture.replace('.h5', '.mueller.h5')})}")
    ready(page)
    keep(page, "mueller")
    page.get_by_label("Beside another product").select_option(capture.replace(".h5", ".with_wedge.mueller.h5"))
    page.get_by_role("button", name="Compare").click()
    ready(page)
    # The errors of unlit pixels have no share in these figures.
    words = r"rms of A − B: 0\.\d+; .* by noise 0\.\d+, by the instrument 0\.\d+; over its error \d"
    expect(page.locator("#told")).to_have_text(re.compile(words))
    # At the rim the difference goes beyond its scale.
    expect(page.locator("#p2 .annotation-text").first).to_have_text(re.compile("[▲▼]"))
    keep(page, "compare")


def _narrow_and_dark(page: Page, address: str, capture: str) -> None:
    page.set_viewport_size({"width": 390, "height": 844})
    page.emulate_media(color_scheme="dark")
    file = urllib.parse.urlencode({"file": capture})
    product = urllib.parse.urlencode({"file": capture.replace(".h5", ".mueller.h5")})
    for address_of_page in ("", "campaign?folder=evening", f"capture?{file}#x=66&y=54", f"product?{product}"):
        page.goto("about:blank")
        page.goto(f"{address}/{address_of_page}")
        if address_of_page:
            ready(page)
        assert fits(page), address_of_page
        background = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert max(int(part) for part in re.findall(r"\d+", background)) < 60
        if address_of_page.startswith("capture"):
            keep(page, "narrow_capture")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"


@pytest.mark.long
def test_a_page_without_its_token_shows_nothing(address, window):
    page = window()
    answer = page.goto(address[: address.rindex("/")] + "/")
    assert answer is not None
    assert answer.status == 403
