"""The list of files: sorted, in pages, with thumbnails, and quick for thousands of files in a real browser."""

import json
import os
import re
import time
from dataclasses import replace

import pytest
from starlette.testclient import TestClient

import viewer.library
from viewer.application import application
from viewer.browsing import MOST


def names(text):
    """Names of the captures of a page, in its order."""
    return re.findall(r'capture\?file=([\w.%]+)"', text)


def test_a_list_is_sorted_by_any_column_and_back(client, drr_capture):
    for number, (omega, sample) in enumerate(((35, "b"), (20, "c"), (110, "a")), 9):
        drr_capture(f"c{number}.h5", omega_deg=omega, sample={"name": sample})
    for column, order in (("omega", [10, 9, 11]), ("sample", [11, 9, 10]), ("name", [9, 10, 11])):
        text = client.get("/", params={"captures_sort": column}).text
        assert names(text) == [f"c{k}.h5" for k in order]
        back = re.search(rf'href="[^"]*(\?[^"]*captures_sort=-{column}[^"]*)#', text)
        assert back, "the header of the column turns the order round"
        assert names(client.get("/", params={"captures_sort": f"-{column}"}).text) == [f"c{k}.h5" for k in order[::-1]]
    assert client.get("/", params={"captures_sort": "beauty", "captures_page": "x"}).status_code == 200


def copies(lab, path, count):
    """The same capture under many names; links to the file itself take no room."""
    for number in range(count):
        os.link(path, lab / f"copy_{number:04}.h5")


def test_pages_have_every_capture_once_and_a_search_stays(client, lab, drr_capture):
    copies(lab, drr_capture("one.h5"), 2 * MOST)
    pages = [names(client.get("/", params={"captures_page": page, "captures_sort": "name"}).text) for page in (1, 2, 3)]
    assert [len(page) for page in pages] == [MOST, MOST, 1]
    assert len({name for page in pages for name in page}) == 2 * MOST + 1
    text = client.get("/", params={"q": "copy", "captures_page": 2}).text
    assert "page 2 of 2, 100 captures" in text
    assert "q=copy" in re.search(r'href="([^"]*)" rel="prev"', text)[1]


@pytest.mark.long
def test_a_second_start_reads_no_file_again(lab, drr_capture, monkeypatch):
    copies(lab, drr_capture("one.h5"), MOST)
    before = [vars(e) for e in viewer.library.Library(lab).entries()]
    assert json.loads((lab / ".umov-view/index.json").read_text())["files"]
    read = []
    original = viewer.library.read_entry
    monkeypatch.setattr(viewer.library, "read_entry", lambda *args: read.append(args[0].name) or original(*args))
    library = viewer.library.Library(lab)
    after = [vars(e) for e in library.entries()]
    assert read == []
    for first, second in zip(before, after, strict=True):
        assert {k: v for k, v in first.items() if k != "header"} == {k: v for k, v in second.items() if k != "header"}
        assert first["header"].sample == second["header"].sample
    # A file that changed is read again, a damaged index is none.
    os.utime(lab / "one.h5", (1, 1))
    library.entries()
    assert read
    (lab / ".umov-view/index.json").write_text("{")
    assert len(viewer.library.Library(lab).entries()) == MOST + 1


def test_files_are_named_while_they_are_read(lab, drr_capture):
    drr_capture("one.h5")
    lines: list[str] = []
    viewer.library.Library(lab).entries(lines.append)
    assert lines == ["1: one.h5"]


def test_three_thousand_captures_have_their_first_page_in_a_second(lab, drr_capture, monkeypatch):
    path = drr_capture("one.h5")
    (entry,) = viewer.library.Library(lab).entries()
    copies(lab, path, 3000)
    with monkeypatch.context() as quick:
        # The first index opens every file, which takes a minute.
        quick.setattr(viewer.library, "read_entry", lambda _, common: replace(entry, **common))
        viewer.library.Library(lab).entries()
    times = []
    for _ in range(3):
        begin = time.process_time()
        client = TestClient(application(lab, "t"), base_url="http://127.0.0.1:8000/t")
        text = client.get("/").text
        times.append(time.process_time() - begin)
    assert len(names(text)) == MOST
    assert "3001 captures" in text
    # Processor time, which other work on the machine does not change.
    assert min(times) < 1.0, times


@pytest.mark.long
@pytest.mark.parametrize("width", [1400, 380])
def test_a_browser_sorts_turns_pages_and_shows_thumbnails(lab, drr_capture, address, browser, width):
    copies(lab, drr_capture("one.h5", omega_deg=35.0), MOST)
    drr_capture("two.h5", omega_deg=20.0)
    page = browser.new_page(viewport={"width": width, "height": 900})
    # Where other work fills the machine, a page takes longer than half a minute.
    page.set_default_timeout(180_000)
    page.goto(address, wait_until="domcontentloaded")
    page.get_by_role("link", name="Ω / deg").click()
    # A click does not wait for the next page.
    page.wait_for_url("**captures_sort=omega**", wait_until="domcontentloaded")
    assert page.locator("table.list tr").nth(1).get_by_role("link").first.inner_text() == "two.h5"
    page.locator("td.thumbnail img").first.wait_for()
    picture = page.locator("td.thumbnail img").first
    assert picture.evaluate("image => image.decode().then(() => image.naturalWidth)") > 0
    page.get_by_role("link", name="next").click()
    page.wait_for_url("**captures_page=2**", wait_until="domcontentloaded")
    assert "page 2 of 2" in page.content()
    assert page.locator("table.list tr").count() == 3
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.close()


def test_pages_suggest_the_program_that_was_started(lab, monkeypatch):
    monkeypatch.setenv("UMOV_DOOR", "umov")
    empty = TestClient(application(lab, "token"), base_url="http://127.0.0.1:8000/token")
    assert "<code>umov acquire" in empty.get("/").text
    assert "<code>umov process reduce" in empty.get("/stack").text
