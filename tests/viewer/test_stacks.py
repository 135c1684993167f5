"""A region followed through the products of a folder: numbers, curves, copies, a browser of a desk and of a phone."""

import csv
import re

import numpy as np
import pytest
from playwright.sync_api import expect

from processing import follow_region
from processing.maps.means import mean_of
from processing.steps.reduction import Reduction

HERE = {"origin": "http://127.0.0.1:8000"}
PLACE = {"x0": "2", "x1": "10", "y0": "3", "y1": "8"}
PART = (slice(3, 8), slice(2, 10))


@pytest.fixture
def night(drr_capture, client):
    """Two samples at three arm angles, with a named region: the diagonal of M gets smaller with the angle."""
    for sample in ("red", "white"):
        for omega in (35.0, 60.0, 110.0):
            share = 0.9 - omega / 200 - 0.1 * (sample == "red")
            capture = drr_capture(
                f"{sample}_{omega:g}.h5",
                mueller=np.diag([1.0, share, share, share]),
                omega_deg=omega,
                seed_of_noise=int(omega),
                sample={"kind": "unknown", "name": sample},
                simulated=True,
            )
            Reduction(capture).make()
    assert client.post("/keep-region", json={"file": "red_35.h5", "name": "spot"} | PLACE, headers=HERE).is_success


def test_a_point_is_the_mean_that_the_command_gives(night, client, drr_capture, lab):
    query = {"kind": "mueller", "name": "mueller", "index": 5, "region": "spot", "label": "m11 over m00"}
    stack = client.get("/stacked", params=query).json()
    assert stack["left_out"] == {}
    assert [(point["sample"], point["omega"]) for point in stack["points"]] == [
        *(("red", omega) for omega in (35.0, 60.0, 110.0)),
        *(("white", omega) for omega in (35.0, 60.0, 110.0)),
    ]
    for point in stack["points"]:
        (mean,) = (value for value in mean_of([lab / point["file"]], PART) if value.name == "m11_over_m00")
        assert (point["value"], point["error"]) == (pytest.approx(mean.value), pytest.approx(mean.u_noise))
        assert point["time"]
    assert len(client.get("/stacked", params=query | {"q": "white 60"}).json()["points"]) == 1
    text = client.get("/stack.csv", params=query).text
    assert text.startswith("# SIMULATED data\n")
    lines = list(csv.DictReader(text.splitlines()[1:]))
    assert [float(line["value"]) for line in lines] == [point["value"] for point in stack["points"]]
    assert {line["region"] for line in lines} == {"spot"}
    assert client.get("/stacked", params=query | {"region": "gone"}).status_code == 404
    # The notebook has the same numbers.
    points, stack = {lab / p["file"]: p for p in stack["points"]}, follow_region(lab, "3:8,2:10")
    stack = stack.sel(quantity="m11_over_m00")
    for file, value, u, omega in zip(*(stack[n].values for n in ("file", "value", "u_noise", "omega")), strict=True):
        point = points[lab / file]
        assert (point["value"], point["error"], point["omega"]) == (pytest.approx(value), pytest.approx(u), omega)
    assert np.isfinite(stack.time.values.astype(float)).all()
    # Images of another form are left out with the reason.
    Reduction(drr_capture("wide.h5", shape=(12, 20), omega_deg=20.0)).make()
    stack = client.get("/stacked", params=query).json()
    assert (len(stack["points"]), list(stack["left_out"].values())) == (6, [1])
    # The middle half is there in every image.
    assert len(client.get("/stacked", params=query | {"region": "middle half of the image"}).json()["points"]) == 7


def test_a_folder_without_products_says_how_to_make_them(client, drr_capture):
    drr_capture("one.h5")
    assert "process reduce" in client.get("/stack").text


@pytest.mark.long
@pytest.mark.parametrize("width", [1400, 380])
def test_a_browser_follows_a_region(night, address, browser, width):
    page = browser.new_context(permissions=["clipboard-read", "clipboard-write"]).new_page()
    page.set_viewport_size({"width": width, "height": 900})
    page.set_default_timeout(60_000)
    expect.set_options(timeout=60_000)
    wrong = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(address)
    page.get_by_role("link", name="Follow a region through the products").click()
    page.locator("body[data-ready]").wait_for()
    page.get_by_label("Region").select_option("spot")
    page.get_by_label("Quantity").select_option("m11 over m00")
    expect(page.locator("#over")).to_have_value("omega")
    expect(page.locator("#told")).to_have_text("6 images")
    curves = page.locator("#stack-curve .scatterlayer .trace")
    expect(curves).to_have_count(2)
    expect(page.locator("#stack-curve .legendtext")).to_have_text(["red", "white"])
    expect(curves.first.locator(".errorbar")).to_have_count(3)
    page.locator("#over").select_option("sample")
    expect(page.locator("#stack-curve .legendtext")).to_have_text(["Ω 35", "Ω 60", "Ω 110"])
    expect(page.locator("#stack-table tr").nth(1).locator("td").nth(1)).to_have_text(
        re.compile(r"^0\.6\d+ ± 0\.0*[1-9]\d$")
    )
    page.get_by_role("button", name="Copy the table").click()
    expect(page.locator("#told")).to_have_text("copied")
    lines = page.evaluate("navigator.clipboard.readText()").splitlines()
    assert len(lines) == 7
    assert re.fullmatch(r"red_35.mueller.h5\t0\.6\d+ ± 0\.\d+\t[\d.]+\t40\tred\t662\t35\t2026-.*", lines[1])
    with page.expect_download() as download:
        page.get_by_role("link", name="Table as CSV").click()
    assert "red_35.mueller.h5" in download.value.path().read_text()
    page.locator("#stack-table").get_by_role("link", name="red_35.mueller.h5").click()
    page.locator("#look").wait_for()
    assert wrong == []
    page.context.close()
