"""Maps of products in the colours of print, and files held against each other."""

import json
import re

import numpy as np
import pytest

from processing.maps.extrapolation import EXTRAPOLATED, PLANES
from processing.reports.colours import colours_of, scale_of
from processing.steps.maps import Quantities
from processing.steps.reduction import Reduction
from processing.storage.captures.schema import CaptureHeader, Detector
from processing.storage.products.product import Plane, Product
from processing.storage.products.product_writer import ProductWriter


def plane(answer):
    assert answer.status_code == 200, answer.text
    header = json.loads(answer.headers["x-plane"])
    return np.frombuffer(answer.content, "<f4").reshape(-1, header["rows"], header["columns"]), header


@pytest.fixture
def products(drr_capture):
    mueller = Reduction(drr_capture("one.h5")).make()
    return mueller, Quantities(mueller).make()


@pytest.mark.parametrize(
    ("name", "units", "colours"),
    [
        ("mueller", "count", "RdBu_r"),
        ("eigenvalue_deviation", "", "RdBu_r"),
        ("polarizance_circular", "", "RdBu_r"),
        ("polarizance_orientation_deg", "degree", "twilight"),
        ("retardance_fast_axis_deg", "degree", "twilight"),
        ("retardance_deg", "degree", "viridis"),
        ("polarizance_orientation_deg_errors", "degree", "magma"),
        ("residual_rms", "count", "viridis"),
        ("s0", "count", "gray"),
        ("pixel_flags", "", "gray"),
    ],
)
def test_what_a_quantity_is_decides_its_colours(name, units, colours):
    assert colours_of(name, units) == colours


def test_signed_scales_are_symmetric_about_zero_and_a_turn_is_a_turn():
    values = np.array([-0.1, 0.5, np.nan])
    signed = scale_of("eigenvalue_deviation", "", values)
    assert signed.low == -signed.high
    turn = scale_of("polarizance_orientation_deg", "degree", values)
    assert (turn.low, turn.high) == (0.0, 180.0)
    empty = scale_of("residual_rms", "count", np.array([np.nan]))
    assert empty.low < empty.high


def test_sixteen_elements_come_on_one_scale(lab, client, products):
    elements, header = plane(client.get("/mueller", params={"file": "one.mueller.h5", "normalized": 1}))
    with Product(products[0]) as reader:
        m = reader.get("mueller").reshape(16, 12, 16)
    np.testing.assert_allclose(elements[1:], m[1:] / m[0], rtol=1e-5)
    np.testing.assert_allclose(elements[0], m[0])
    assert header["low"] == -header["high"]
    assert header["units"] == ""
    errors, header = plane(client.get("/mueller", params={"file": "one.mueller.h5", "errors": 1}))
    assert header["colours"] == "magma"
    assert np.all(errors > 0)


def test_a_map_comes_with_its_errors_and_without_what_is_not_valid(client, products):
    xi, _ = plane(
        client.get("/plane", params={"file": "one.quantities.h5", "name": "coherency_eigenvalues", "index": 0})
    )
    errors, header = plane(
        client.get("/plane", params={"file": "one.quantities.h5", "name": "coherency_eigenvalues", "errors": 1})
    )
    assert np.median(xi) == pytest.approx(0.55, abs=0.01)
    assert header["colours"] == "magma"
    assert 0 < np.median(errors) < 0.03
    page = client.get("/product", params={"file": "one.quantities.h5"}).text
    assert "one.mueller.h5" in page


def test_a_pixel_of_a_product_leads_back_to_its_intensities(client, products):
    probe = client.get("/probe", params={"file": "one.mueller.h5", "x0": 3, "y0": 4}).json()
    assert probe["mask"] == "valid"
    assert len(probe["fit"]["signal"]) == 40
    assert probe["matrix"]["mueller"][1][1] == pytest.approx(0.5, abs=0.2)
    derived = client.get("/probe", params={"file": "one.quantities.h5", "x0": 3, "y0": 4}).json()
    named = {plane["name"]: plane for plane in derived["planes"]}
    assert sum(named["coherency_eigenvalues"]["value"]) == pytest.approx(1, abs=1e-5)


def test_what_differs_by_noise_alone_is_one_error_apart(client, drr_capture):
    drr_capture("one.h5")
    drr_capture("two.h5", seed_of_noise=2)
    for name in ("one", "two"):
        assert client.get("/capture", params={"file": f"{name}.h5"}).status_code == 200
    dark = {"a": "one.h5", "b": "two.h5", "state": 0}
    (a, b, apart, _), header = plane(client.get("/difference", params=dark))
    np.testing.assert_allclose(apart, a - b)
    assert header["rms"] == 0
    _, header = plane(client.get("/difference", params={**dark, "state": 10}))
    assert header["rms_over"] == pytest.approx(1, abs=0.2)


def test_two_products_of_the_same_scene_differ_by_their_errors(client, lab, drr_capture):
    Reduction(drr_capture("one.h5")).make()
    Reduction(drr_capture("two.h5", seed_of_noise=2, mueller=np.diag([1.0, 0.6, 0.4, 0.3]))).make()
    query = {"a": "one.mueller.h5", "b": "two.mueller.h5", "name": "mueller"}
    assert client.get("/compare", params=query).status_code == 200
    _, equal = plane(client.get("/difference", params={**query, "index": 10}))
    (_, _, apart, _), difference = plane(client.get("/difference", params={**query, "index": 5}))
    assert equal["rms_over"] == pytest.approx(1, abs=0.2)
    assert np.median(apart) == pytest.approx(-0.1, abs=0.01)
    assert difference["rms_over"] > 2


def test_products_of_one_capture_share_its_noise(client, lab, drr_capture, configs, tmp_path):
    """Two instrument files: the difference scatters by far less than the noise of each, and by its own errors."""
    capture = drr_capture("one.h5")
    instrument = tmp_path / "other.yaml"
    instrument.write_text((configs / "instruments/rgb950.yaml").read_text().replace("662: 127.12", "662: 129.12"))
    Reduction(capture).make()
    Reduction(capture, instrument).make(out=lab / "other.mueller.h5")
    query = {"a": "one.mueller.h5", "b": "other.mueller.h5", "name": "mueller", "index": 10}
    (_, _, apart, over), _ = plane(client.get("/difference", params=query))
    with Product(lab / "one.mueller.h5") as product:
        alone = np.median(product.get("mueller_errors")[2, 2] / product.get("mueller")[0, 0])
    assert np.nanstd(apart) < 0.3 * alone
    assert np.nanstd(over) == pytest.approx(1, abs=0.2)
    # So do maps of quantities.
    (values, _, apart, over), _ = plane(client.get("/difference", params=query | {"name": "depolarization_index"}))
    assert np.nanmedian(values) == pytest.approx((0.5 / 3) ** 0.5, abs=0.02)
    assert np.nanstd(apart) < 0.3 * np.nanstd(values)
    assert np.nanstd(over) == pytest.approx(1, abs=0.25)


def test_a_ratio_has_the_errors_that_it_scatters_by(client, lab, drr_capture, configs, tmp_path):
    instrument = tmp_path / "other.yaml"
    instrument.write_text((configs / "instruments/rgb950.yaml").read_text().replace("662: 127.12", "662: 129.12"))
    capture = drr_capture("one.h5")
    Reduction(capture).make()
    Reduction(capture, instrument).make(out=lab / "same.mueller.h5")
    Reduction(drr_capture("two.h5", seed_of_noise=2, mueller=np.diag([1.0, 0.6, 0.4, 0.3]))).make()
    query = {"a": "one.mueller.h5", "name": "mueller", "index": 5, "ratio": 1}
    # Of two captures their errors count both, of one capture what the two products do not share.
    (a, b, apart, over), header = plane(client.get("/difference", params=query | {"b": "two.mueller.h5"}))
    np.testing.assert_allclose(apart, a / b - 1, atol=1e-6)
    assert np.median(apart) == pytest.approx(0.5 / 0.6 - 1, abs=0.01)
    assert np.std(over) == pytest.approx(1, abs=0.2)
    (_, _, close, _), shared = plane(client.get("/difference", params=query | {"b": "same.mueller.h5"}))
    assert np.std(close) == pytest.approx(shared["rms_noise"], rel=0.2)
    assert shared["rms_noise"] < 0.3 * header["rms_noise"]
    # An element that is zero divides nothing, an angle and counts have no ratio.
    (_, _, none, _), _ = plane(client.get("/difference", params=query | {"b": "two.mueller.h5", "index": 1}))
    assert np.mean(np.isnan(none)) > 0.99
    for refused in ({"b": "two.mueller.h5", "name": "diattenuation_orientation_deg"}, {"a": "one.h5", "b": "two.h5"}):
        assert client.get("/difference", params=query | refused).status_code == 422


def test_a_difference_has_what_the_instruments_do_not_do_alike(client, lab, drr_capture, configs, tmp_path):
    """One instrument moves M of one sample alike in two captures, not that of another sample; two instruments add."""
    text = (configs / "instruments/rgb950.yaml").read_text()
    files = []
    for value in ("127.12", "94.78"):
        files.append(tmp_path / f"{value}.yaml")
        files[-1].write_text(text.replace(f"662: {value}", f"662: {{value: {value}, u: 0.5}}"))
    # Another instrument whose uncertain inputs have the same names.
    files.append(tmp_path / "lent.yaml")
    files[-1].write_text(files[0].read_text().replace("name: RGB950", "name: RGB950 that was lent"))
    first, second = drr_capture("one.h5"), drr_capture("two.h5", seed_of_noise=2)
    third = drr_capture("three.h5", seed_of_noise=3, mueller=np.diag([1.0, 0.6, 0.1, 0.3]))
    for k, (capture, file) in enumerate(((first, 0), (second, 0), (third, 0), (second, 1), (second, 2))):
        Reduction(capture, files[file]).make(out=lab / f"{k}.mueller.h5")
    headers = {}
    for k in (1, 2, 3, 4):
        query = {"a": "0.mueller.h5", "b": f"{k}.mueller.h5", "name": "mueller", "index": 10}
        (_, _, apart, over), headers[k] = plane(client.get("/difference", params=query))
        expected = np.hypot(headers[k]["rms_noise"], headers[k]["rms_systematic"])
        assert np.nanstd(apart) / np.nanstd(over) == pytest.approx(expected, rel=0.1)
    with Product(lab / "0.mueller.h5") as product:
        alone = np.median(product.get("mueller_systematic")[2, 2] / product.get("mueller")[0, 0])
    # What is left is the noise of the matrices that are moved.
    assert headers[1]["rms_systematic"] < 0.2 * alone
    assert headers[2]["rms_systematic"] > 0.3 * alone
    assert headers[3]["rms_systematic"] >= 0.99 * alone
    assert headers[4]["rms_systematic"] == pytest.approx(np.sqrt(2) * alone, rel=0.1)


def test_what_is_not_there_or_of_another_kind_is_not_compared(client, products):
    pair = {"a": "one.mueller.h5", "b": "one.mueller.h5", "name": "mueller"}
    assert client.get("/difference", params=pair).status_code == 200
    for query in ({"index": 16}, {"index": "x"}, {"name": "nothing"}, {"name": ""}):
        assert client.get("/difference", params=pair | query).status_code == 422, query
    answer = client.get("/compare", params={"a": "one.h5", "b": "one.mueller.h5"}, headers={"accept": "text/html"})
    assert answer.status_code == 422
    assert "nothing in common" in answer.text


def test_a_fact_without_a_value_reads_as_on_the_console(client, lab):
    header = CaptureHeader(title="", simulated=True, mode="drr", wavelength_nm=662, detector=Detector())
    with ProductWriter(
        lab / "p.h5", "mueller", header, (2, 3), planes={"valid": Plane((), "", "v", "u1")}, steps=()
    ) as writer:
        writer.write(slice(0, 2), valid=np.ones((2, 3), np.uint8))
        writer.seal({"warnings": [], "median_reduced_chi_square": float("nan"), "darks": None})
    page = client.get("product?file=p.h5").text
    assert re.search(r"median reduced chi square</t[hd]>\s*<td[^>]*>none</td>", page)
    assert re.search(r"darks</t[hd]>\s*<td[^>]*>none</td>", page)


@pytest.mark.parametrize(
    ("name", "period"), [("diattenuation_orientation_deg", 180.0), ("retardance_axis_or_90_deg", 90.0)]
)
def test_orientations_either_side_of_their_wrap_are_neighbours(name, period, client, lab):
    header = CaptureHeader(title="", simulated=True, mode="drr", wavelength_nm=662, detector=Detector())
    planes = {name: Plane((), "degree", "an axis"), f"{name}_errors": Plane((), "degree", "its errors")}
    for file, angles in (("a", [1.0, period - 1.0]), ("b", [period - 1.0, 1.0])):
        with ProductWriter(lab / f"{file}.h5", "quantities", header, (1, 2), planes=planes, steps=()) as writer:
            writer.write(slice(0, 1), **{name: np.array([angles]), f"{name}_errors": np.full((1, 2), 2.0)})
            writer.seal({"warnings": []})
    (_, _, apart, over), scale_header = plane(
        client.get("/difference", params={"a": "a.h5", "b": "b.h5", "name": name})
    )
    np.testing.assert_allclose(apart, [[2, -2]], atol=1e-4)
    np.testing.assert_allclose(over, [[2 / 8**0.5, -2 / 8**0.5]], atol=1e-4)
    assert scale_header["scales"][0] == {"colours": "twilight", "low": 0.0, "high": period}
    (value,) = client.get("/probe", params={"file": "a.h5", "x0": 0, "x1": 2, "y0": 0, "y1": 1}).json()["planes"]
    assert (value["value"][0] + 10) % period == pytest.approx(10, abs=1e-6)
    assert value["error"][0] == pytest.approx(2 / 2**0.5)


def test_an_angle_that_is_noise_has_no_colour(client, lab):
    header = CaptureHeader(title="", simulated=True, mode="stokes", wavelength_nm=662, detector=Detector())
    planes = {"aolp_deg": Plane((), "degree", "an angle"), "aolp_deg_errors": Plane((), "degree", "its errors")}
    for file, errors in (("some", [[1.0, np.nan]]), ("unknown", [[np.nan, np.nan]])):
        with ProductWriter(lab / f"{file}.h5", "stokes", header, (1, 2), planes=planes, steps=()) as writer:
            writer.write(slice(0, 1), aolp_deg=np.array([[10.0, 120.0]]), aolp_deg_errors=np.array(errors))
            writer.seal({"warnings": []})
    shown = {
        file: plane(client.get("/plane", params={"file": f"{file}.h5", "name": "aolp_deg"}))[0]
        for file in ("some", "unknown")
    }
    np.testing.assert_array_equal(shown["some"], [[[10, np.nan]]])
    np.testing.assert_array_equal(shown["unknown"], [[[10, 120]]])


def test_a_pixel_of_an_extrapolated_image_has_its_matrix_with_errors(client, lab):
    header = CaptureHeader(title="", simulated=True, mode="stokes", wavelength_nm=662, detector=Detector())
    mueller = np.diag([200.0, 100.0, 80.0, 60.0])[..., None, None].repeat(2, axis=-1)
    with ProductWriter(lab / "e.h5", EXTRAPOLATED, header, (1, 2), planes=PLANES, steps=()) as writer:
        writer.write(
            slice(0, 1),
            mueller=mueller,
            mueller_errors=mueller / 100,
            m00_correlation=np.zeros((1, 2)),
            valid=np.ones((1, 2)),
        )
        writer.seal({"warnings": []})
    matrix = client.get("/probe", params={"file": "e.h5", "x0": 1, "y0": 0}).json()["matrix"]
    assert (matrix["m00"], matrix["m00_error"]) == (200, 2)
    np.testing.assert_allclose(np.diag(matrix["mueller"]), [1, 0.5, 0.4, 0.3], rtol=1e-6)
    # One percent of alpha_0 and one of m00, which are not correlated here.
    assert matrix["mueller_errors"][1][1] == pytest.approx(0.5 * 0.01 * 2**0.5, rel=1e-4)


def test_a_folder_that_was_moved_keeps_what_was_made_from_what(lab, client, products):
    """A night copied to another disc: provenance has the old paths."""
    (lab / "night").mkdir()
    for path in lab.glob("*.h5"):
        path.rename(lab / "night" / path.name)
    pixel = {"file": "night/one.mueller.h5", "x0": 3, "y0": 2}
    probe = client.get("/probe", params=pixel).json()
    assert "fit" in probe, probe["told"]
    page = client.get("/product", params={"file": "night/one.mueller.h5"}).text
    assert re.search(r'capture\s+<a href="[^"]*capture\?file=night', page)
    # Another capture of the same name and size is not its source.
    capture = lab / "night" / "one.h5"
    raw = bytearray(capture.read_bytes())
    raw[-1] ^= 1
    capture.write_bytes(raw)
    assert "not in the folder" in client.get("/probe", params=pixel).json()["told"]
