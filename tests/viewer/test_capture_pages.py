"""What the application says of captures: lists, frames, histograms and the intensities of a pixel."""

import json
import re

import numpy as np
import pytest

from processing.instrument.model import InstrumentModel
from processing.steps.reduction import Reduction
from processing.storage.formats.import_request import ImportRequest
from processing.storage.formats.importing import import_capture
from processing.storage.products.product import Product


def plane(answer):
    header = json.loads(answer.headers["x-plane"])
    return np.frombuffer(answer.content, "<f4").reshape(-1, header["rows"], header["columns"]), header


def test_the_first_page_lists_what_is_there_and_names_what_is_broken(lab, client, drr_capture):
    drr_capture("one.h5", title="a red sphere", omega_deg=35.0)
    (lab / "deep").mkdir()
    (lab / "deep" / "broken.h5").write_bytes(b"no HDF5 at all")
    page = client.get("/").text
    assert "one.h5" in page
    assert "44 of 44" in page
    assert "SIMULATED" in page
    assert re.search(r"deep/broken.h5.*cannot be opened as HDF5.*unreadable", page, re.S)


def test_a_link_to_a_file_of_the_folder_is_that_file(lab, client):
    (lab / "one.h5").write_bytes(b"no HDF5")
    (lab / "two.h5").symlink_to("one.h5")
    page = client.get("/").text
    assert page.count("<td>one.h5") == 1


def test_search_finds_by_what_a_capture_is(client, drr_capture):
    drr_capture("one.h5", sample={"name": "leaf"}, omega_deg=35.0)
    drr_capture("two.h5", sample={"name": "mirror"}, omega_deg=35.0)
    page = client.get("/", params={"q": "LEAF omega 35 662"}).text
    assert "one.h5" in page


def test_text_of_a_header_is_never_a_page_s_own(client, drr_capture):
    drr_capture("one.h5", title="<script>alert(1)</script>", sample={"name": "</script><b>x"})
    for address, query in (("/", {}), ("/capture", {"file": "one.h5"})):
        page = client.get(address, params=query).text
        assert "<script>alert" not in page
        assert "</script><b>x" not in page


def test_a_changed_file_is_read_again(client, drr_capture):
    drr_capture("one.h5", title="before")
    assert "before" in client.get("/capture", params={"file": "one.h5"}).text
    drr_capture("one.h5", title="afterwards", shape=(12, 18))
    assert "afterwards" in client.get("/capture", params={"file": "one.h5"}).text


def test_a_frame_is_the_counts_of_the_file(client, drr_capture):
    drr_capture("one.h5")
    (counts, red), header = plane(client.get("/frame", params={"file": "one.h5", "state": 0}))
    assert counts.shape == (12, 16)
    assert np.all(counts == 64)
    assert not red.any()
    assert header["step"] == 1


def test_a_reduced_frame_keeps_the_mean_and_every_saturated_pixel(lab, client, synthetic_capture):
    frames = np.full((1, 1, 100, 130), 1000, np.uint16)
    frames[0, 0, 57, 101] = 4095
    frames[0, 0, ::2] += 2
    synthetic_capture(frames, {}, name="lab/one.h5", detector={"bits": 12})
    (counts, red), header = plane(client.get("/frame", params={"file": "one.h5", "state": 0, "most": 16}))
    step = header["step"]
    assert max(counts.shape) <= 16
    assert np.median(counts) == pytest.approx(1001, abs=0.2)
    assert np.argwhere(red).tolist() == [[57 // step, 101 // step]]
    part, header = plane(
        client.get("/frame", params={"file": "one.h5", "x0": 100, "x1": 110, "y0": 50, "y1": 60, "most": 16})
    )
    assert (header["x0"], header["y0"], header["step"]) == (100, 50, 1)
    assert np.argwhere(part[1]).tolist() == [[7, 1]]


def test_the_histogram_counts_every_pixel_once(client, drr_capture):
    drr_capture("one.h5")
    histogram = client.get("/histogram", params={"file": "one.h5", "state": 10}).json()
    assert sum(histogram["pixels"]) == 12 * 16
    widths = np.diff(histogram["edges"])
    assert np.all(widths == widths[0])
    assert widths[0] == round(widths[0])


def test_what_is_not_there_is_refused_in_words(client, drr_capture):
    drr_capture("one.h5")
    for query in ({"state": 44}, {"state": "x"}, {"channel": 1}, {"x0": "nan"}, {"state": -45}):
        answer = client.get("/frame", params={"file": "one.h5", **query})
        assert answer.status_code == 422, query
        assert "Traceback" not in answer.text


def test_a_pixel_is_reduced_as_its_product_is(lab, client, drr_capture):
    path = drr_capture("one.h5")
    product = Reduction(path).make()
    pixel = {"file": "one.h5", "x0": 5, "y0": 7}
    curve = client.get("/curve", params=pixel).json()
    matrix = client.get("/matrix", params=pixel).json()["matrix"]
    with Product(product) as reader:
        m = reader.get("mueller")[:, :, 7, 5].astype(float)
        error = reader.get("mueller_errors")[0, 0, 7, 5]
    np.testing.assert_allclose(matrix["mueller"], m / m[0, 0], atol=1e-5)
    assert matrix["m00_error"] == pytest.approx(error, rel=1e-4)
    residual = np.array(curve["fit"]["residual"])
    assert curve["fit"]["states"] == list(range(4, 44))
    assert np.sqrt(np.mean(residual**2)) < 1.5
    assert np.ptp(curve["fit"]["signal"]) > 200


def test_the_noise_that_a_states_file_states_is_that_of_the_curve(lab, client, configs):
    lines = ["state,psg_deg,channel_left,channel_right,sigma"]
    lines += [f"{k},{4 * k},{1000 + k},{500 + 3 * k},{2 + k}" for k in range(46)]
    states, instrument = lab / "states.csv", configs / "instruments" / "drr_wollaston.yaml"
    states.write_text("\n".join(lines) + "\n", encoding="utf-8")
    import_capture(ImportRequest(states, lab / "one.h5", 1200, instrument=instrument))
    fit = client.get("/curve", params={"file": "one.h5", "x0": 0, "y0": 0}).json()["fit"]
    assert fit["noise_known"]
    assert fit["noise"] == pytest.approx(np.repeat(2.0 + np.arange(46), 2))


def test_a_region_is_the_mean_of_its_pixels_with_a_smaller_error(client, drr_capture):
    drr_capture("one.h5")
    pixel = client.get("/matrix", params={"file": "one.h5", "x0": 5, "y0": 7}).json()["matrix"]
    region = client.get("/matrix", params={"file": "one.h5", "x0": 0, "y0": 0, "x1": 16, "y1": 12}).json()["matrix"]
    assert region["m00_error"] == pytest.approx(pixel["m00_error"] / np.sqrt(192), rel=0.05)
    np.testing.assert_allclose(region["mueller"], np.diag([1, 0.5, 0.4, 0.3]), atol=0.01)
    xi = region["quantities"]["coherency_eigenvalues"]["value"]
    assert sum(xi) == pytest.approx(1)
    assert xi[0] == pytest.approx(0.55, abs=0.01)


def test_a_super_pixel_has_a_curve_for_each_analyzer_and_a_stokes_vector(client, lab, configs, synthetic_capture):
    mosaic = (("90", "45"), ("135", "0"))
    s, shape, states = 1000 * np.array([1, 0.3, -0.2]), (8, 12), 12
    names = np.tile(np.array(mosaic, dtype=float), (shape[0] // 2, shape[1] // 2))
    light = 0.5 * (s[0] + s[1] * np.cos(np.deg2rad(2 * names)) + s[2] * np.sin(np.deg2rad(2 * names)))
    signal = np.repeat(light[None], states, axis=0)
    rng = np.random.default_rng(1)
    noisy = signal + rng.normal(size=signal.shape) * np.sqrt(signal / 2.6 + (2.3 / 2.6) ** 2)
    frames = np.round(np.concatenate([np.full((4, *shape), 64.0), 64 + noisy])).astype(np.uint16)
    path = synthetic_capture(
        frames[:, None],
        {"psg": np.zeros(states + 4)},
        role=("dark",) * 4 + ("sample",) * states,
        mosaic=mosaic,
        channels=("mosaic",),
        instrument_yaml=(configs / "instruments/linear_stokes.yaml").read_text(),
        detector={"black_level_counts": 64.0, "gain_e_per_count": 2.6, "read_noise_e": 2.3, "bits": 12},
    )
    path.rename(lab / "mosaic.h5")
    query = {"file": "mosaic.h5", "x0": 0, "y0": 0, "x1": 12, "y1": 8}
    fit = client.get("/curve", params=query).json()["fit"]
    assert fit["series"] == ["0°", "45°", "90°", "135°"]
    assert fit["chi_square"] == pytest.approx(1, abs=0.5)
    np.testing.assert_allclose(fit["fitted"][:4], [650, 400, 350, 600], rtol=0.01)
    for name, true in (("S0", 1000), ("S1/S0", 0.3), ("S2/S0", -0.2), ("AoLP / degrees", 163.15)):
        element = fit["stokes"][name]
        assert abs(element["value"] - true) < 4 * element["error"] < 0.03 * abs(true), name
    # One pixel is widened to its super-pixel.
    single = client.get("/curve", params={"file": "mosaic.h5", "x0": 5, "y0": 3}).json()["fit"]
    assert "columns 4 to 5, rows 2 to 3" in single["told"]
    assert single["stokes"]["S0"]["error"] == pytest.approx(fit["stokes"]["S0"]["error"] * np.sqrt(24), rel=0.05)
    assert client.get("/matrix", params=query).json().keys() == {"where"}
    # Its product, where it is.
    product = Reduction(lab / "mosaic.h5").make()
    probe = client.get("/probe", params={"file": product.name, "x0": 5, "y0": 3}).json()
    assert probe["fit"]["stokes"] == single["stokes"]


def test_a_super_pixel_behind_a_turned_generator_has_a_curve_for_each_analyzer_and_a_matrix(
    client, configs, synthetic_capture
):
    file = configs / "instruments" / "mosaic_polarimeter.yaml"
    model = InstrumentModel.load(file)
    angles = {"psg": 15.0 * np.arange(24)}
    m = np.diag([1, 0.6, 0.5, 0.3])
    m[0, 1] = 0.1
    signal = dict(zip([c.name for c in model.channels], 3000 * (model.rows(angles) @ m.ravel()).T, strict=True))
    cell = np.array([[signal[name] for name in row] for row in model.mosaic]).transpose(2, 0, 1)
    # A row of super-pixels with twice the light each.
    light = np.repeat(2.0 ** np.arange(3), 2)
    frames = np.round(64 + np.tile(cell, (1, 2, 3)) * light).astype(np.uint16)
    detector = {"black_level_counts": 64.0, "gain_e_per_count": 1.0, "read_noise_e": 2.0, "bits": 16}
    path = synthetic_capture(
        frames[:, None],
        angles,
        name="lab/turned.h5",
        mosaic=model.mosaic,
        channels=("mosaic",),
        instrument_yaml=file.read_text(),
        detector=detector,
    )
    query = {"file": "turned.h5", "x0": 3, "y0": 1}
    fit = client.get("/curve", params=query).json()["fit"]
    assert fit["series"] == ["0°", "45°", "90°", "135°"]
    assert "columns 2 to 3, rows 0 to 1" in fit["told"]
    np.testing.assert_allclose(
        fit["fitted"][:4], 2 * np.array([signal[n][0] for n in ("0", "45", "90", "135")]), rtol=1e-3
    )
    matrix = client.get("/matrix", params=query).json()["matrix"]
    np.testing.assert_allclose(np.array(matrix["mueller"], float)[:3], m[:3], atol=2e-3)
    assert np.isnan(np.array(matrix["mueller"], float)[3]).all()
    # Its product has one pixel for each super-pixel.
    product = Reduction(path).make()
    probe = client.get("/probe", params={"file": product.name, "x0": 1, "y0": 0}).json()
    assert probe["fit"] == fit
    # A region is the mean of its super-pixels, whole.
    region = client.get("/curve", params={"file": "turned.h5", "x0": 1, "y0": 1, "x1": 5, "y1": 2}).json()["fit"]
    np.testing.assert_allclose(region["fitted"], np.array(fit["fitted"]) / 2 * 7 / 3, rtol=1e-3)


def test_a_pixel_where_the_retardance_varies_is_reduced_as_its_product_is(client, configs, synthetic_capture):
    text = (
        (configs / "instruments" / "rgb950.yaml").read_text()
        + """
effects:
  - kind: field_retardance
    element: psa_retarder
    parameters: {x: &c {value: 6.0, unit: degree}, y: *c, x2: *c, xy: *c, y2: *c}
"""
    )
    model = InstrumentModel.load(configs / "instruments" / "rgb950.yaml").at(662)
    angles = {"psg": 9.0 * np.arange(40), "psa": 44.19 * np.arange(40)}
    light = 3000 * model.rows(angles)[:, :, None, None] @ np.diag([1, 0.6, 0.5, 0.3]).ravel() * np.ones((4, 6))
    path = synthetic_capture(light.astype(np.uint16), angles, name="lab/one.h5", instrument_yaml=text)
    with Product(Reduction(path).make()) as product:
        m = product.get("mueller")[:, :, 1, 5].astype(float)
    answer = client.get("/matrix", params={"file": "one.h5", "x0": 5, "y0": 1})
    np.testing.assert_allclose(answer.json()["matrix"]["mueller"], m / m[0, 0], atol=1e-5)


def test_beams_have_a_curve_each(client, configs, synthetic_capture):
    file = configs / "instruments" / "drr_wollaston.yaml"
    model, angles = InstrumentModel.load(file), {"psg": 7.3 * np.arange(30)}
    signal = 3000 * model.rows(angles) @ np.diag([1, 0.6, 0.5, 0.3]).ravel()
    synthetic_capture(
        np.round(signal[..., None, None] * np.ones((2, 3))).astype(np.uint16),
        angles,
        name="lab/beams.h5",
        channels=("left", "right"),
        instrument_yaml=file.read_text(),
    )
    fit = client.get("/curve", params={"file": "beams.h5", "x0": 1, "y0": 1}).json()["fit"]
    assert fit["series"] == ["left", "right"]
    np.testing.assert_allclose(fit["fitted"], signal.ravel(), atol=1)


def test_a_pixel_of_a_partial_polarimeter_has_the_elements_that_it_sees(client, configs, synthetic_capture):
    text = (configs / "instruments" / "linear_mueller.yaml").read_text()
    model = InstrumentModel.load(configs / "instruments" / "linear_mueller.yaml")
    angles = {"psg": 13.0 * np.arange(30), "psa": 37.0 * np.arange(30)}
    signal = 3000 * model.rows(angles)[:, 0] @ np.diag([1, 0.6, 0.5, 0.3]).ravel()
    frames = np.round(12 + signal[:, None, None, None] * np.ones((4, 5))).astype(np.uint16)
    detector = {"black_level_counts": 12.0, "gain_e_per_count": 1.0, "read_noise_e": 2.0, "bits": 16}
    path = synthetic_capture(frames, angles, name="lab/one.h5", instrument_yaml=text, detector=detector)
    Reduction(path).make()
    for page, file in (("curve", "one.h5"), ("matrix", "one.h5"), ("probe", "one.mueller.h5")):
        answer = client.get(page, params={"file": file, "x0": 2, "y0": 1})
        assert answer.status_code == 200, answer.text
        if page != "curve":
            m = np.array(answer.json()["matrix"]["mueller"], float)
            np.testing.assert_allclose(m[:3, :3], np.diag([1, 0.6, 0.5]), atol=1e-3)
            assert np.isnan([*m[3], *m[:, 3]]).all()
            assert answer.json()["matrix"]["quantities"] == {}


def test_a_probe_outside_the_image_is_refused(client, drr_capture):
    drr_capture("one.h5")
    for query in ({"x0": 16, "y0": 0}, {"x0": 5, "y0": 3, "x1": 5, "y1": 9}, {"x0": 1}, {"x0": 0, "y0": -1}):
        assert client.get("/curve", params={"file": "one.h5", **query}).status_code == 422


def test_counts_that_are_none_are_told_as_unknown(client, synthetic_capture):
    frames = np.full((2, 1, 6, 8), 100, np.float32)
    frames[1, 0, 2, 3] = np.nan
    synthetic_capture(frames, {}, name="lab/float.h5")
    answer = client.get("/curve", params={"file": "float.h5", "x0": 3, "y0": 2})
    assert answer.status_code == 200
    assert answer.json()["counts"] == [100, None]
