"""Named regions: kept once for the folder, measured in every image that has them."""

import csv
import json
import re

import numpy as np
import pytest
from playwright.sync_api import expect

from processing.maps.means import mean_of
from processing.steps.maps import Quantities
from processing.steps.reduction import Reduction
from processing.storage.captures.capture import Capture
from processing.storage.products.product import Product

HERE = {"origin": "http://127.0.0.1:8000"}
PLACE = {"x0": "2", "x1": "10", "y0": "3", "y1": "8"}
PART = (slice(3, 8), slice(2, 10))


def keep(client, name="spot", file="one.h5", **place):
    return client.post("/keep-region", json={"file": file, "name": name} | PLACE | place, headers=HERE)


def regions(client, **query):
    answer = client.get("/regions", params={"file": "one.h5"} | query)
    assert answer.status_code == 200, answer.text
    return {row["name"]: row for row in answer.json()["regions"]}


def test_a_region_is_kept_in_a_file_and_carried_to_other_images(lab, client, drr_capture):
    drr_capture("one.h5")
    drr_capture("two.h5", seed_of_noise=2)
    drr_capture("larger.h5", shape=(24, 32))
    drr_capture("other.h5", shape=(12, 20))
    assert keep(client).status_code == 200
    (region,) = json.loads((lab / ".umov-view/regions.json").read_text())["regions"]
    assert region == {"name": "spot", "columns": [2, 10], "rows": [3, 8], "image": [12, 16]}
    assert regions(client, file="two.h5")["spot"]["where"] == "columns 2 to 9, rows 3 to 7 (40 pixels)"
    # The same place on an image of twice the pixels; none where the images have another form.
    assert regions(client, file="larger.h5")["spot"]["where"] == "columns 4 to 19, rows 6 to 15 (160 pixels)"
    assert regions(client, file="other.h5") == {}
    # The same name is the same region, moved.
    keep(client, x0="0")
    keep(client, "edge")
    assert {name: row["pixels"] for name, row in regions(client).items()} == {"spot": 50, "edge": 40}
    assert client.post("/drop-region", json={"name": "spot"}, headers=HERE).status_code == 200
    assert list(regions(client)) == ["edge"]
    assert client.post("/drop-region", json={"name": "spot"}, headers=HERE).status_code == 404


def test_what_is_no_region_is_not_kept(lab, client, drr_capture):
    drr_capture("one.h5")
    for wrong in ({"name": ""}, {"name": "<b>"}, {"name": "=1+1"}, {"x1": "17"}, {"x0": "a"}):
        assert keep(client, **wrong).status_code == 422, wrong
    assert not (lab / ".umov-view/regions.json").exists()


def test_a_damaged_file_is_named_and_not_replaced(lab, client, drr_capture):
    drr_capture("one.h5")
    keep(client)
    (lab / ".umov-view/regions.json").write_text('{"regions": [{"name": 3}]}')
    for answer in (keep(client, "new"), client.get("/regions", params={"file": "one.h5"})):
        assert answer.status_code == 422
        assert "regions.json" in answer.text
    assert (lab / ".umov-view/regions.json").read_text() == '{"regions": [{"name": 3}]}'


def test_a_region_of_a_frame_is_that_of_the_file(client, drr_capture):
    with Capture(drr_capture("one.h5")) as capture:
        counts = capture.frames(10)[0][PART].astype(float)
    keep(client)
    spot = regions(client, state=10)["spot"]
    assert spot["value"] == pytest.approx(counts.mean(), rel=1e-6)
    assert spot["spread"] == pytest.approx(counts.std(ddof=1), rel=1e-5)
    assert spot["pixels"] == sum(spot["histogram"]["pixels"]) == 40
    assert spot["columns"] == pytest.approx(counts.mean(axis=0).tolist(), rel=1e-6)
    assert spot["rows"] == pytest.approx(counts.mean(axis=1).tolist(), rel=1e-6)
    # The error is the noise of light and camera, which is what scatters here.
    assert spot["error"] == pytest.approx(spot["spread"] / 40**0.5, rel=0.4)
    # One that is only drawn comes first, and has no name.
    drawn = client.get("/regions", params={"file": "one.h5", "x0": 0, "y0": 0, "x1": 4, "y1": 2}).json()["regions"]
    assert [row["name"] for row in drawn] == ["", "spot"]


def test_a_region_of_a_matrix_is_the_mean_that_the_command_gives(client, configs, drr_capture):
    text = (configs / "instruments/rgb950.yaml").read_text().replace("662: 127.12", "662: {value: 127.12, u: 0.3}")
    product = Reduction(drr_capture("one.h5", instrument_yaml=text)).make()
    keep(client)
    means = {mean.name: mean for mean in mean_of([product], PART)}
    with Product(product) as opened:
        m = opened.get("mueller").reshape(16, 12, 16)
    for query, name, values in (
        ({"name": "mueller", "index": 5}, "m11_over_m00", (m[5] / m[0])[PART]),
        ({"name": "mueller", "index": 0}, "m00", m[0][PART]),
        ({"name": "depolarization_index"}, "depolarization_index", None),
    ):
        spot = regions(client, file="one.mueller.h5", **query)["spot"]
        assert spot["value"] == pytest.approx(means[name].value)
        assert spot["error"] == pytest.approx(means[name].u_noise)
        assert spot["systematic"] == pytest.approx(means[name].u_systematic)
        if values is not None:
            assert spot["spread"] == pytest.approx(values.std(ddof=1), rel=1e-4)


def test_orientations_are_averaged_over_their_turn(client, drr_capture):
    # Polarizance at 0 degrees: half the pixels are just above it and half just below 180.
    m = np.diag([1.0, 0.5, 0.4, 0.3])
    m[1, 0] = 0.3
    Quantities(Reduction(drr_capture("one.h5", mueller=m)).make()).make()
    keep(client)
    spot = regions(client, file="one.quantities.h5", name="polarizance_orientation_deg")["spot"]
    assert min(spot["value"], 180 - spot["value"]) < 2
    assert spot["spread"] < 10


def test_every_region_and_quantity_is_a_line_of_a_table(client, drr_capture):
    Reduction(drr_capture("one.h5")).make()
    keep(client)
    keep(client, "edge", x0="0")
    answer = client.get("/regions.csv", params={"file": "one.mueller.h5"})
    assert answer.headers["content-type"].startswith("text/csv")
    assert "attachment" in answer.headers["content-disposition"]
    text = [line for line in answer.text.splitlines() if not line.startswith("#")]
    lines = list(csv.DictReader(text))
    assert {line["region"] for line in lines} == {"spot", "edge"}
    (m11,) = [line for line in lines if line["region"] == "spot" and line["quantity"] == "m11 over m00"]
    assert float(m11["value"]) == regions(client, file="one.mueller.h5", name="mueller", index=5)["spot"]["value"]
    assert m11["pixels"] == "40"
    frames = client.get("/regions.csv", params={"file": "one.h5"}).text
    assert len(re.findall(r"^spot,.*state \d+", frames, re.MULTILINE)) == 44


def test_an_error_has_two_digits_and_its_value_ends_with_it(client, browser, address):
    texts = {
        "-0.100212 ± 0.000031": (-0.10021234, [0.0000312]),
        "0.500 ± 0.010": (0.5, [0.00999]),
        "123460 ± 230": (123456, [231]),
        "0.5123 ± 0.0021 ± 0.1300": (0.51234, [0.0021, 0.13]),
        "0.0000123 ± 0": (0.0000123, [0]),
        "1.5 ± ?": (1.5, [None]),
        "0.000 ± 0.017": (-0.0002, [0.017]),
    }
    page = browser.new_page()
    page.goto(address)
    shown = page.evaluate(
        "async ([root, all]) => { const { measured } = await import(root + '/static/plots.js');"
        " return all.map(([value, errors]) => measured(value, errors)); }",
        [address, list(texts.values())],
    )
    assert shown == list(texts)


@pytest.mark.long
@pytest.mark.parametrize("width", [1400, 380])
def test_a_browser_keeps_a_region_and_finds_it_on_another_capture(
    lab, drr_capture, address, browser, draw_region, width
):
    Reduction(drr_capture("one.h5")).make()
    drr_capture("two.h5", seed_of_noise=2)
    viewport = {"width": width, "height": 900}
    context = browser.new_context(permissions=["clipboard-read", "clipboard-write"], viewport=viewport)
    page = context.new_page()
    page.set_default_timeout(60_000)
    expect.set_options(timeout=60_000)
    wrong = []
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(f"{address}/capture?file=one.h5")
    page.locator("body[data-ready]").wait_for()
    draw_region(page, (0.3, 0.3), (0.7, 0.7))
    page.get_by_label("Name of the region").fill("spot")
    page.get_by_role("button", name="Keep", exact=True).click()
    page.locator("#region-table").get_by_text("spot").wait_for()
    page.goto(f"{address}/capture?file=two.h5")
    page.locator("#region-table").get_by_text("spot").wait_for()
    page.locator("#region-histogram .bars").first.wait_for()
    page.goto(f"{address}/product?file=one.mueller.h5")
    mean = page.locator("#region-table tr").nth(1).locator("td").nth(3)
    before = mean.inner_text()
    page.get_by_label("Quantity of the regions").select_option("m11 over m00")
    # The table is drawn anew once the answer is there; what was copied before is no longer said.
    expect(mean).not_to_have_text(before)
    # Two digits of error, and the value ends where it does.
    expect(mean).to_have_text(re.compile(r"^0\.\d+ ± 0\.0*[1-9]\d$"))
    # What is copied is the table, tabs between its columns, as a spreadsheet takes it.
    page.evaluate("navigator.clipboard.writeText('before')")
    page.locator("#regions-copy").click()
    expect(page.locator("#regions-told")).to_have_text("copied")
    table = [
        [cell.inner_text() for cell in row.locator("td, th").all()[:6]]
        for row in page.locator("#region-table tr").all()
    ]
    copied = [line.split("\t") for line in page.evaluate("navigator.clipboard.readText()").splitlines()]
    assert copied == table
    assert [line[0] for line in copied] == ["region", "spot"]
    page.locator("#region-table").get_by_role("button", name="Remove spot").click()
    page.locator("#region-table").get_by_text("spot").wait_for(state="detached")
    assert wrong == []
    context.close()
