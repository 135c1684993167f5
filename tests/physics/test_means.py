"""Means over a region and over captures: within their own errors, with shared noise of demosaiced pixels, and GUM."""

import csv
import json

import numpy as np
import pytest
from test_instrument_uncertainty import ANGLES, SAMPLE, STEP, drawn, mueller_image, stated  # noqa: F401
from typer.testing import CliRunner

from processing.commands.application import app
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.maps import quantities
from processing.maps.means import mean_of
from processing.polarization.quantities import depolarization_index
from processing.reduction.mueller import reduce_mueller
from processing.reduction.stokes import reduce_stokes
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Product

WHOLE = (slice(0, 32), slice(0, 32))
#: Electrons a state: little light, so that means of maps of magnitudes would be off by many of their errors.
LIGHT = 300.0
DETECTOR = {"gain_e_per_count": 1.0, "read_noise_e": 2.0, "black_level_counts": 50.0, "bits": 16}


def mueller_product(synthetic_capture, tmp_path, model, truth, random, name="a", scale=1.0):
    light = scale * LIGHT * truth.rows(ANGLES).reshape(-1, 16) @ SAMPLE.reshape(16)
    frames = random.poisson(np.broadcast_to(light[:, None, None, None], (40, 1, 32, 32))).astype(float)
    frames += 50 + random.normal(0, 2, frames.shape)
    path = synthetic_capture(np.round(frames).astype(np.uint16), ANGLES, name=f"{name}.h5", detector=DETECTOR)
    out = tmp_path / f"{name}.mueller.h5"
    with Capture(path) as capture:
        reduce_mueller(capture, model, out, (STEP,))
    return out


@pytest.mark.long
def test_means_of_1024_pixels_hold_their_errors(rgb950, synthetic_capture, tmp_path):
    """Every number of 20 means: all within a few of their errors, 95 % inside their intervals."""
    random = np.random.default_rng(11)
    bright = mueller_product(synthetic_capture, tmp_path, rgb950, rgb950, random, "bright", 100.0)
    truth = {mean.name: mean.value for mean in mean_of([bright], WHOLE)}
    assert truth["depolarization_index"] == pytest.approx(float(depolarization_index(SAMPLE)), abs=0.001)
    inside, pulls = {}, {}
    for k in range(20):
        product = mueller_product(synthetic_capture, tmp_path, rgb950, rgb950, random, f"m{k}")
        for mean in mean_of([product], WHOLE):
            if mean.name == "m00" or mean.unit == "degree":
                continue
            inside.setdefault(mean.name, []).append(mean.low <= truth[mean.name] <= mean.high)
            pulls.setdefault(mean.name, []).append((mean.value - truth[mean.name]) / mean.u_noise)
    elements = [name for name in pulls if name.startswith("m")]
    assert len(elements) == 15
    assert np.sqrt(np.mean([np.square(pulls[name]) for name in elements])) == pytest.approx(1, abs=0.12)
    assert np.mean([inside[name] for name in elements]) == pytest.approx(0.95, abs=0.04)
    for name in ("depolarization_index", "diattenuation", "polarizance", "coherency_eigenvalues_0"):
        assert max(np.abs(pulls[name])) < 3.5, name
        assert np.mean(inside[name]) > 0.8, name


@pytest.mark.long
def test_a_mosaic_mean_knows_what_neighbours_share(configs, synthetic_capture, tmp_path):
    """Errors of pixels over sqrt(n) are 1.7 to 2.7 too small."""
    random = np.random.default_rng(3)
    model = InstrumentModel.load(configs / "instruments/linear_stokes.yaml").at(662)
    expected = model.rows({"": np.zeros(1)})[0] @ SAMPLE.reshape(16) * 4000
    where = {c: (r, k) for r, line in enumerate(model.mosaic) for k, c in enumerate(line)}
    pulls, by_name = [], {}
    for k in [*range(25), None]:
        frames = np.zeros((1, 1, 64, 64))
        for channel, level in zip((c.name for c in model.channels), expected, strict=True):
            r, c = where[channel]
            frames[0, 0, r::2, c::2] = level if k is None else random.poisson(level, (32, 32))
        detector = {"gain_e_per_count": 1.0, "read_noise_e": 0.0, "black_level_counts": 0.0}
        path = synthetic_capture(frames.astype(np.float32), {}, name=f"s{k}.h5", mosaic=model.mosaic, detector=detector)
        with Capture(path) as capture:
            reduce_stokes(capture, model, tmp_path / f"s{k}.stokes.h5", (STEP,))
        means = mean_of([tmp_path / f"s{k}.stokes.h5"], (slice(16, 48), slice(16, 48)))
        by_name[k] = {mean.name: mean for mean in means}
    for k in range(25):
        names = ("s0", "s1_over_s0", "s2_over_s0", "dolp")
        pulls.append([(by_name[k][n].value - by_name[None][n].value) / by_name[k][n].u_noise for n in names])
    assert np.sqrt(np.mean(np.square(pulls), axis=0)) == pytest.approx(np.ones(4), abs=0.4)
    assert np.abs(pulls).max() < 4
    with Product(tmp_path / "s0.stokes.h5") as product:
        alone = np.sqrt(np.square(product.get("s1_errors")[16:48, 16:48]).sum()) / 1024 / product.get("s0").mean()
    assert by_name[0]["s1_over_s0"].u_noise > 1.5 * alone


def test_the_instrument_does_not_average_and_scatter_of_captures_counts(stated, synthetic_capture, tmp_path):  # noqa: F811
    random = np.random.default_rng(8)
    model = InstrumentModel.load(stated).at(662)
    capture = mueller_product(synthetic_capture, tmp_path, model, model, random, "one")
    quarter = {v.name: v for v in mean_of([capture], (slice(0, 16), slice(0, 16)))}
    image = {v.name: v for v in mean_of([capture], WHOLE)}
    name = "m11_over_m00"
    assert image[name].u_noise == pytest.approx(quarter[name].u_noise / 2, rel=0.05)
    assert image[name].u_systematic == pytest.approx(quarter[name].u_systematic, rel=0.05)
    part = next(c for c in image[name].budget if c.source.startswith("psg_retarder.retardance_deg (RGB950"))
    assert part.u == pytest.approx(abs(part.sensitivity) * 0.3)
    # A bench that is mounted anew for each capture: its scatter, with few degrees of freedom.
    anew = [
        mueller_product(synthetic_capture, tmp_path, model, drawn(model, random), random, f"n{k}", 30.0)
        for k in range(4)
    ]
    night = {v.name: v for v in mean_of(anew, WHOLE)}
    assert night[name].scatter > 5 * night[name].u_noise
    assert night[name].budget[0].degrees_of_freedom == 3
    assert night[name].budget[0].u == pytest.approx(night[name].scatter / 2)


def test_an_instrument_that_is_off_moves_m00(stated, synthetic_capture, tmp_path):  # noqa: F811
    """Its 95 % interval had noise alone and covered 8 % of 200 drawn instruments."""
    model = InstrumentModel.load(stated).at(662)
    off = model.with_values({"analyzer": {"azimuth_deg": model.value_of("analyzer.azimuth_deg") + 0.1}})
    images = [
        mueller_image(synthetic_capture, tmp_path, model, truth, None, name)
        for name, truth in (("exact", model), ("moved", off))
    ]
    exact, moved = ({v.name: v for v in mean_of([image], WHOLE)}["m00"] for image in images)
    part = next(c for c in exact.budget if c.source.startswith("analyzer.azimuth_deg"))
    assert part.u > 3 * exact.u_noise
    assert part.u == pytest.approx(abs(moved.value - exact.value), rel=0.02)


def test_what_two_instruments_do_averages(stated, synthetic_capture, tmp_path):  # noqa: F811
    """Their inputs have the same names; one instrument moves both captures alike."""
    model, random = InstrumentModel.load(stated).at(662), np.random.default_rng(9)
    lent = model.model_copy(update={"name": "another RGB950"})
    of_one = [mueller_product(synthetic_capture, tmp_path, model, model, random, name) for name in ("a", "b")]
    of_other = mueller_product(synthetic_capture, tmp_path, lent, model, random, "c")
    name = "m11_over_m00"
    alone, shared, apart = (
        next(v for v in mean_of(sources, WHOLE) if v.name == name)
        for sources in (of_one[:1], of_one, [of_one[0], of_other])
    )
    assert shared.u_systematic == pytest.approx(alone.u_systematic, rel=0.05)
    assert apart.u_systematic == pytest.approx(alone.u_systematic / np.sqrt(2), rel=0.05)
    assert len(apart.budget) == 2 * len(shared.budget) - 1
    exact_model = model.model_copy(update={"stderr": {}})
    with pytest.raises(ProcessError, match="not of one kind"):
        mean_of([of_one[0], mueller_product(synthetic_capture, tmp_path, exact_model, model, random, "d")], WHOLE)


def test_the_command_writes_csv_json_and_a_budget(stated, synthetic_capture, tmp_path):  # noqa: F811
    model = InstrumentModel.load(stated).at(662)
    product = mueller_product(synthetic_capture, tmp_path, model, model, np.random.default_rng(1))
    table, tree = tmp_path / "means.csv", tmp_path / "means.json"
    command = ["mean", str(product), "--region", "0:32,0:32", "--out"]
    result = CliRunner().invoke(app, [*command, str(table), "--budget", "depolarization_index"])
    assert result.exit_code == 0, result.output
    assert "psg_retarder.retardance_deg" in result.output
    assert "U95" in result.output
    assert CliRunner().invoke(app, [*command, str(tree)]).exit_code == 0
    rows = list(csv.DictReader(line for line in table.read_text().splitlines() if not line.startswith("#")))
    means = {mean["name"]: mean for mean in json.loads(tree.read_text())["means"]}
    assert {row["name"] for row in rows} == set(means)
    row = next(row for row in rows if row["name"] == "depolarization_index")
    assert float(row["value"]) == pytest.approx(float(depolarization_index(SAMPLE)), abs=0.02)
    assert sum(c["u"] ** 2 for c in means["depolarization_index"]["budget"]) == pytest.approx(float(row["u"]) ** 2)
    wrong = CliRunner().invoke(app, ["mean", str(product), "--budget", "dolp"])
    assert wrong.exit_code != 0


def test_what_does_not_exist_in_a_mean_has_its_whole_range(rgb950, synthetic_capture, tmp_path):
    """Its interval was NaN to NaN."""
    product = mueller_product(synthetic_capture, tmp_path, rgb950, rgb950, np.random.default_rng(2), "dim", 0.02)
    pixels = [(slice(0, 1), slice(k, k + 1)) for k in range(12)]
    means = [v for pixel in pixels for v in mean_of([product], pixel) if v.name == "retardance_deg"]
    assert any(np.isnan(v.value) for v in means)
    assert all((v.low, v.high) == (0, 180) for v in means if np.isnan(v.value))


def test_quantities_of_parts_are_those_of_the_whole_image(rgb950, synthetic_capture, tmp_path, monkeypatch):
    product = mueller_product(synthetic_capture, tmp_path, rgb950, rgb950, np.random.default_rng(2))
    image, moves = MuellerImage.load(product), np.random.default_rng(3).normal(size=(2, 16, 32, 32))
    whole = quantities.quantities_block(image, quantities.EXTRA, {}, moves)
    monkeypatch.setattr(quantities, "CACHED_PIXELS", 300)
    parts = quantities.quantities_block(image, quantities.EXTRA, {}, moves)
    assert list(parts) == list(whole)
    for name, plane in whole.items():
        # Sums of float32, whose order the BLAS chooses by their number, and which may cancel.
        largest = np.nanmax(np.abs(plane), initial=1, where=np.isfinite(plane))
        np.testing.assert_allclose(parts[name], plane, rtol=1e-5, atol=1e-6 * largest, err_msg=name)
