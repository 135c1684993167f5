"""Standard uncertainties that an instrument file states reach every number that follows, apart from the noise."""

import numpy as np
import pytest
from typer.testing import CliRunner

from processing.campaign.run import compare_on_sphere
from processing.commands.application import app
from processing.errors import ProcessError
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.instrument.uncertainty import value_directions
from processing.maps.extrapolation import extrapolate_mueller
from processing.maps.material_fit import fit_products
from processing.maps.quantities import quantities_of_mueller
from processing.maps.tables import tabulate
from processing.maps.xi0 import dominant_model, xi0_of_mueller
from processing.polarization import mueller, triply_degenerate
from processing.reduction.mueller import reduce_mueller
from processing.reduction.stokes import reduce_stokes
from processing.reflectance.tables import ScatteringTable
from processing.storage.captures.capture import Capture
from processing.storage.products.product import Product, Step
from processing.yaml_file import ConfigError, parse_yaml
from simulators.bench.scene import Scene

STEP = Step("test", {})
ANGLES = dict(rotating_retarders(1.0, 40, 9.0, 4.91).angles_deg)
#: As a file states them.
U = {
    "psg_retarder.retardance_deg": 0.3,
    "psg_retarder.azimuth_deg": 0.1,
    "psa_retarder.retardance_deg": 0.3,
    "psa_retarder.azimuth_deg": 0.1,
    "analyzer.azimuth_deg": 0.1,
}
SAMPLE = (
    0.55 * mueller.diattenuator(0.4, 1.0, 0.6) @ mueller.retarder(0.9, np.deg2rad(40.0)) @ np.diag([1, 0.7, 0.6, 0.5])
)
COUNTS = 1_000_000.0
TOLD = ("diattenuation_linear", "depolarization_index", "retardance_deg", "polarizance_linear")


@pytest.fixture
def stated(configs, tmp_path):
    """The RGB950 with standard uncertainties of its values, as a text and as a model at 662 nm."""
    text = (configs / "instruments/rgb950.yaml").read_text()
    for name, u in U.items():
        element, field = name.split(".")
        at = text.index(field, text.index(f"name: {element}"))
        end = text.index("}", at)
        value = text[at:end].rpartition("662: ")[2].split(",")[0]
        text = text[:at] + text[at:end].replace(f"662: {value}", f"662: {{value: {value}, u: {u}}}") + text[end:]
    path = tmp_path / "stated.yaml"
    path.write_text(text)
    return path


def drawn(model, random):
    values = {}
    for name, u in U.items():
        element, _, field = name.rpartition(".")
        values.setdefault(element, {})[field] = model.value_of(name) + u * random.normal()
    return model.with_values(values)


def mueller_image(synthetic_capture, tmp_path, model, truth, random, name="a", rows=4, **header):
    """Mueller image of a sample that another instrument than the model's measured."""
    light = COUNTS * truth.rows(ANGLES).reshape(-1, 16) @ SAMPLE.reshape(16)
    frames = np.broadcast_to(light[:, None, None, None], (40, 1, rows, rows)).astype(np.float32)
    if random is not None:
        frames = random.poisson(frames).astype(np.float32)
    detector = {"gain_e_per_count": 1.0, "read_noise_e": 1.0, "black_level_counts": 0.0}
    path = synthetic_capture(frames, ANGLES, name=f"{name}.h5", detector=detector, **header)
    product = tmp_path / f"{name}.mueller.h5"
    with Capture(path) as capture:
        reduce_mueller(capture, model, product, (STEP,))
    return product


def with_xi0(*arguments, **more):
    """The Mueller image, and xi0."""
    image = mueller_image(*arguments, **more)
    xi0 = image.with_name(image.name.replace(".mueller.", ".xi0."))
    xi0_of_mueller(image, xi0, STEP, False, progress=None)
    return image, xi0


def products(*arguments, **more):
    """The Mueller image, its quantities and xi0."""
    image, xi0 = with_xi0(*arguments, **more)
    quantities = image.with_name(image.name.replace(".mueller.", ".quantities."))
    quantities_of_mueller(image, quantities, STEP)
    return image, quantities, xi0


def read(paths):
    maps = {}
    for path, names in zip(paths[1:], (TOLD, ("xi0",)), strict=True):
        with Product(path) as product:
            for name in names:
                ends = product.get(f"{name}_95") if f"{name}_95" in product.names else None
                systematic = product.get(f"{name}_systematic") if f"{name}_systematic" in product.names else 0.0
                maps[name] = (product.get(name), product.get(f"{name}_errors"), systematic, ends)
    return maps


def test_a_file_states_them_with_the_values(stated, configs):
    plain, model = (InstrumentModel.load(path) for path in (configs / "instruments/rgb950.yaml", stated))
    assert model.at(662).stderr == U
    assert model.at(451).stderr == {}
    assert model.model_copy(update={"stderr": {}}) == plain
    assert {direction.label: direction.u for direction in value_directions(model.at(662))} == U
    with pytest.raises(ConfigError, match=r"psg_retarder.retardance_deg.*0 or more"):
        parse_yaml(stated.read_text().replace("u: 0.3", "u: -0.3"), InstrumentModel)


def test_correlated_values_move_together(stated):
    text = stated.read_text() + (
        "correlations:\n  - between: [psg_retarder.azimuth_deg, analyzer.azimuth_deg]\n    coefficients: [0.96]\n"
    )
    model = parse_yaml(text, InstrumentModel).at(662)
    moved = [direction.moved for direction in value_directions(model) if "&" in direction.label]
    off = np.array(
        [[variant.value_of(n) - model.value_of(n) for n in model.correlations[0].between] for variant in moved]
    )
    assert off.T @ off == pytest.approx(0.01 * np.array([[1, 0.96], [0.96, 1]]), abs=1e-9)


@pytest.mark.long
def test_total_intervals_cover_drawn_instruments(stated, synthetic_capture, tmp_path):
    """30 instruments drawn from the stated uncertainty; noise alone would cover few of them."""
    random = np.random.default_rng(5)
    model = InstrumentModel.load(stated).at(662)
    exact = read(products(synthetic_capture, tmp_path, model, model, None, "exact"))
    inside, alone, pulls = ({name: [] for name in (*TOLD, "xi0")} for _ in range(3))
    for k in range(30):
        maps = read(products(synthetic_capture, tmp_path, model, drawn(model, random), random, f"r{k}"))
        for name, (value, error, systematic, ends) in maps.items():
            off = value - exact[name][0].mean()
            pulls[name].append(np.square(off / np.hypot(error, systematic)).mean())
            inside[name].append(((value - off >= ends[0]) & (value - off <= ends[1])).mean())
            alone[name].append((np.abs(off) < 1.96 * error).mean())
    for name in pulls:
        # 30 instruments: the rms of their pulls is known to 13 %, a coverage of 95 % to 4.
        assert 0.7 < np.sqrt(np.mean(pulls[name])) < 1.4, name
        assert np.mean(inside[name]) > 0.87, name
    assert np.mean(alone["diattenuation_linear"]) < 0.7


def test_calibrate_writes_what_it_does_not_know(synthetic_capture, configs, tmp_path):
    """The written file alone makes a systematic error; a second calibration replaces it."""
    random = np.random.default_rng(2)
    plain = configs / "instruments/rgb950.yaml"
    light = 2000 * InstrumentModel.load(plain).at(662).rows(ANGLES).reshape(-1, 16) @ np.eye(4).reshape(16)
    frames = random.poisson(np.broadcast_to(light[:, None, None, None], (40, 1, 8, 8)) + 100).astype(np.uint16)
    detector = {"black_level_counts": 100, "bits": 16}
    air = synthetic_capture(frames, ANGLES, name="air.h5", sample={"kind": "air"}, detector=detector)
    free, once, twice = "psg_retarder.retardance_deg,psa_retarder.azimuth_deg", tmp_path / "1.yaml", tmp_path / "2.yaml"
    for start, written in ((plain, once), (once, twice)):
        command = ["calibrate", str(air), "--instrument", str(start), "--free", free, "--write", str(written)]
        assert CliRunner().invoke(app, command).exit_code == 0
    model = InstrumentModel.load(once).at(662)
    assert set(model.stderr) == set(free.split(","))
    assert 0.005 < model.stderr["psg_retarder.retardance_deg"] < 0.5
    assert abs(model.value_of("psg_retarder.retardance_deg") - 127.12) < 4 * model.stderr["psg_retarder.retardance_deg"]
    second = InstrumentModel.load(twice)
    assert second.at(662).stderr == model.stderr
    assert len(second.correlations) == 1
    paths = products(synthetic_capture, tmp_path, model, model, None)
    with Product(paths[1]) as product:
        assert "psg_retarder.retardance_deg" in product.facts["uncertain_in_the_instrument"]
        assert (product.get("diattenuation_systematic") > 0).all()


def test_a_table_holds_what_each_direction_does_to_its_means(stated, synthetic_capture, tmp_path, configs):
    """The instrument's part of the mean over a bin is as large as that of one pixel; noise is not."""
    model = InstrumentModel.load(stated).at(662)
    header = {"omega_deg": 35.0, "rows": 48}
    geometry = configs / "geometries/one_inch_sphere.yaml"
    _, xi0 = with_xi0(synthetic_capture, tmp_path, model, model, np.random.default_rng(4), **header)
    table = tabulate([xi0], geometry, "degree")
    assert table.inputs == tuple(f"{name} ({model.identity})" for name in model.stderr)
    with Product(xi0) as product:
        of_pixel = np.median(product.get("xi0_systematic"))
    assert np.median(table.uncertainties["u_systematic"]) == pytest.approx(of_pixel, rel=0.05)
    exact_model = model.model_copy(update={"stderr": {}})
    _, plain = with_xi0(synthetic_capture, tmp_path, exact_model, exact_model, None, "plain", **header)
    with pytest.raises(ProcessError, match="process reduce --instrument"):
        tabulate([plain], geometry, "degree", table)


@pytest.mark.long
def test_a_mueller_table_covers_an_instrument_that_is_off_and_its_noise(stated, synthetic_capture, tmp_path, configs):
    """One uncertain value off by u moves every element of every bin by its direction; the noise is that of repeats."""
    model = InstrumentModel.load(stated).at(662)
    exact_model = model.model_copy(update={"stderr": {}})
    off = model.with_values({"psg_retarder": {"retardance_deg": model.value_of("psg_retarder.retardance_deg") + 0.3}})
    geometry, header = configs / "geometries/one_inch_sphere.yaml", {"omega_deg": 35.0, "rows": 32}

    def table(used, truth, random, name):
        image = mueller_image(synthetic_capture, tmp_path, used, truth, random, name, **header)
        return tabulate([image], geometry, "renderer")

    exact, moved, declared = (
        table(exact_model, exact_model, None, "e"),
        table(exact_model, off, None, "m"),
        table(model, exact_model, None, "t"),
    )
    assert set(exact.uncertainties) == {"u_noise"}
    direction = declared.directions[declared.inputs.index(f"psg_retarder.retardance_deg ({model.identity})")]
    # What the instrument really does is the opposite of what a wrong file does.
    shift = moved.mean / moved.mean[0] - exact.mean / exact.mean[0]
    assert np.abs(shift).max() > 1e-3
    ratio = (direction - direction[0] * declared.mean / declared.mean[0]) / declared.mean[0]
    assert -ratio == pytest.approx(shift, rel=0.02, abs=1e-5)
    off_m00 = moved.mean[0] / exact.mean[0] - 1
    assert -direction[0] / declared.mean[0] == pytest.approx(off_m00, rel=0.02, abs=1e-5)
    assert np.all(declared.uncertainties["u_systematic"] ** 2 >= direction**2)
    random = np.random.default_rng(1)
    repeats = [table(exact_model, exact_model, random, f"n{k}") for k in range(24)]
    pulls = [(r.mean - exact.mean) / r.uncertainties["u_noise"] for r in repeats]
    # 24 repeats of some 100 bins in each element.
    assert np.sqrt(np.mean(np.square(pulls), axis=(0, 2))) == pytest.approx(np.ones(16), abs=0.1)


@pytest.mark.long
def test_what_two_instruments_do_to_a_table_adds_as_squares(stated, synthetic_capture, tmp_path, configs):
    """Their inputs have the same names. One instrument moves all images of a table alike."""
    model = InstrumentModel.load(stated).at(662)
    lent = model.model_copy(update={"name": "another RGB950"})
    geometry, header = configs / "geometries/one_inch_sphere.yaml", {"omega_deg": 35.0, "rows": 32}
    paths = [
        with_xi0(synthetic_capture, tmp_path, used, model, None, name, **header)
        for used, name in ((model, "a"), (model, "b"), (lent, "c"), (lent, "d"))
    ]
    for kind in (0, 1):

        def u_systematic(*numbers, kind=kind):
            return tabulate([paths[k][kind] for k in numbers], geometry, "degree").uncertainties["u_systematic"]

        alone = u_systematic(0)
        assert u_systematic(0, 1) == pytest.approx(alone, rel=1e-4, abs=1e-9)
        assert u_systematic(0, 2) == pytest.approx(alone / np.sqrt(2), rel=1e-4, abs=1e-9)
        assert u_systematic(2, 0, 3) == pytest.approx(alone * np.sqrt(5) / 3, rel=1e-4, abs=1e-9)
    view = ViewingGeometry.load(geometry)
    of_a, of_b, of_c = (tabulate([paths[k][1]], geometry, "degree") for k in range(3))
    shared, independent = (compare_on_sphere(of_a, table, view, 35.0, shape=(32, 32)) for table in (of_b, of_c))
    assert shared["xi0_systematic_percent"] == pytest.approx(0, abs=1e-6)
    size = 100 * np.sqrt(2 * np.mean(np.square(of_a.uncertainties["u_systematic"])))
    assert independent["xi0_systematic_percent"] == pytest.approx(size, rel=0.2)


def sphere_capture(synthetic_capture, configs, truth, name, **kind):
    """The red sphere without noise, as an instrument measures it: its captures differ by the instrument alone."""
    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    m = np.nan_to_num(scene.mueller_image(35.0, 662, 48, 48)).reshape(48, 48, 16).astype(float)
    angles = {} if truth.mosaic else ANGLES
    light = COUNTS * np.einsum("scm,xym->scxy", truth.rows(angles or {"": np.zeros(1)}), m)
    if truth.mosaic:
        frames = np.zeros((1, 1, 48, 48))
        index = [channel.name for channel in truth.channels]
        for (r, c), channel in np.ndenumerate(np.array(truth.mosaic)):
            frames[0, 0, r::2, c::2] = light[0, index.index(channel), r::2, c::2]
        light, kind = frames, kind | {"mosaic": truth.mosaic}
    detector = {"gain_e_per_count": 1.0, "read_noise_e": 1.0, "black_level_counts": 0.0}
    return synthetic_capture(light.astype(np.float32), angles, name=name, detector=detector, omega_deg=35.0, **kind)


@pytest.mark.parametrize("kind", ["mueller", "correlation", "stokes"])
def test_the_instruments_uncertainty_reaches_fitted_constants(stated, synthetic_capture, configs, tmp_path, kind):
    """A value that is off by u moves n and k by what the fit says of it; the chi-square does not blame the model."""
    name, u = ("analyzer.azimuth_deg", 0.2) if kind == "stokes" else ("psa_retarder.azimuth_deg", 0.1)
    model = InstrumentModel.load(
        configs / "instruments" / ("linear_stokes.yaml" if kind == "stokes" else "rgb950.yaml")
    )
    model = model.at(662)
    if kind == "stokes":
        name = "micropolarizer_45.azimuth_deg"
    element, _, field = name.rpartition(".")
    off = model.with_values({element: {field: model.value_of(name) + u}})
    path = sphere_capture(synthetic_capture, configs, off, "s.h5")
    fits = []
    for used in (off, model.model_copy(update={"stderr": {name: u}})):
        product = tmp_path / f"{len(fits)}.h5"
        with Capture(path) as capture:
            (reduce_stokes if kind == "stokes" else reduce_mueller)(capture, used, product, (STEP,))
        geometry = configs / "geometries/one_inch_sphere.yaml"
        fits.append(fit_products([product], geometry, correlation=kind == "correlation")[0])
    exact, nominal = fits
    moved, error = nominal.constants - exact.constants, np.sqrt(np.diag(nominal.systematic))
    assert np.abs(moved[0]) > 1e-4
    assert not exact.systematic.any()
    assert error == pytest.approx(np.abs(moved), rel=0.15, abs=2e-4)
    assert nominal.chi_square < 1.1 * exact.chi_square + 0.05
    assert any("the instrument's uncertainty: n" in note for note in nominal.notes(["a"]))


def test_compared_tables_share_the_error_of_one_instrument(configs):
    """It is in their difference as far as it differs; two instruments add."""
    view = ViewingGeometry.load(configs / "geometries/one_inch_sphere.yaml")
    angles = view.at(35.0, 60, 60).points.angles

    def table(value, moved, label):
        entries = ScatteringTable(("xi0",), 662, has_noise=True, inputs=(label,))
        entries.add(angles, np.broadcast_to(np.array([[value], [0.0], [moved]]), (3, angles.theta_h.size)))
        return entries

    for source, expected in (("analyzer", 1.0), ("micropolarizer", np.hypot(3.0, 4.0))):
        comparison = compare_on_sphere(
            table(0.5, 0.03, "analyzer"), table(0.6, 0.04, source), view, 35.0, shape=(60, 60)
        )
        assert comparison["xi0_percent"] == pytest.approx(10)
        assert comparison["xi0_systematic_percent"] == pytest.approx(expected)


def test_an_extrapolated_matrix_and_its_quantities_have_the_instruments_part(configs, synthetic_capture, tmp_path):
    """One standard uncertainty of a micropolarizer moves M/m00 and its maps by one systematic standard error."""
    scene = configs / "geometries/one_inch_sphere.yaml", configs / "materials/red_print.yaml"
    model = InstrumentModel.load(configs / "instruments/linear_stokes.yaml").at(662)
    name, u = "micropolarizer_45.azimuth_deg", 0.2
    true = model.with_values({"micropolarizer_45": {"azimuth_deg": 45 + u}})
    header = {"omega_deg": 35.0}
    detector = {"gain_e_per_count": 1.0, "read_noise_e": 1.0, "black_level_counts": 0.0}
    frames = np.ones((1, 1, 64, 76), np.float32)
    blank = synthetic_capture(frames, {}, name="blank.h5", mosaic=model.mosaic, detector=detector, **header)
    with Capture(blank) as capture:
        m0 = dominant_model(capture.header, *scene, (64, 76))
    light = np.nan_to_num(triply_degenerate.mueller_matrix(m0, np.full((64, 76), 0.5), np.full((64, 76), 4e6)))
    intensity = np.einsum("ck,xyk->cxy", true.rows({"": np.zeros(1)})[0], light.reshape(64, 76, 16))
    for (r, c), channel in np.ndenumerate(np.array(model.mosaic)):
        index = [product_maps.name for product_maps in model.channels].index(channel)
        frames[0, 0, r::2, c::2] = intensity[index, r::2, c::2]
    path = synthetic_capture(frames, {}, name="s.h5", mosaic=model.mosaic, detector=detector, **header)
    products = []
    for used in (true, model.model_copy(update={"stderr": {name: u}})):
        stokes, mueller, maps = (tmp_path / f"{len(products)}.{kind}.h5" for kind in ("stokes", "m", "q"))
        with Capture(path) as capture:
            reduce_stokes(capture, used, stokes, (STEP,))
        extrapolate_mueller(stokes, *scene, mueller, step=STEP, overwrite=False)
        quantities_of_mueller(mueller, maps, STEP)
        with Product(mueller) as product, Product(maps) as derived:
            names = [n for n in derived.names if n.startswith("depolarization_index")]
            products.append({n: product.get(n) for n in product.names} | {n: derived.get(n) for n in names})
    exact, nominal = products
    inside = (exact["valid"] > 0) & (nominal["valid"] > 0) & (np.abs(m0[..., 0, 1]) > 0.05)
    assert inside.sum() > 300
    m, m_nominal = (product_maps["mueller"][..., inside] for product_maps in products)
    index = "depolarization_index"
    for moved, error in (
        (m_nominal / m_nominal[0, 0] - m / m[0, 0], nominal["mueller_systematic"][..., inside] / m_nominal[0, 0]),
        ((nominal[index] - exact[index])[inside], nominal[f"{index}_systematic"][inside]),
    ):
        assert np.abs(moved).max() > 5e-4
        # To first order: a fifth of the largest is of second.
        assert error == pytest.approx(np.abs(moved), rel=0.1, abs=2e-4)
        assert np.linalg.norm(error) == pytest.approx(np.linalg.norm(moved), rel=0.05)
