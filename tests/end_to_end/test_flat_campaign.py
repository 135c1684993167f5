"""A campaign with darks, flats and air references on the emulators, down to the products.

Every pixel of the bench responds differently and the light of the field is uneven; nothing of the rig says so, and the
products are rid of it.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from processing.steps.reduction import Reduction
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage, StokesImage
from processing.storage.products.product import Product
from simulators.bench.scene import Scene
from tests.commands import exit_code
from tests.rig_files import write_rig

# The campaign that all of them share is what takes its time.
pytestmark = pytest.mark.long
SHAPE = (96, 112)
UNDECLARED = [{"kind": "pixel_response", "sigma": 0.05}, {"kind": "uneven_light", "corner_loss": 0.4, "gradient": 0.3}]
OMEGAS = (40, 50, 60)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory, configs) -> Path:
    """Folder of a campaign taken by `acquire --campaign`: flats before the first and after the second capture."""
    from acquisition.commands.application import main

    folder = tmp_path_factory.mktemp("flats")
    bench = {"rows": SHAPE[0], "columns": SHAPE[1], "clock_speed": 200, "effects": UNDECLARED, "flux_e_per_s": 4e6}
    write_rig(configs, folder / "rig.yaml", **bench)
    states = {"drr": "{kind: rotating_retarders, states: 30, step_deg: 12}", "stokes": "{kind: fixed, states: 10}"}
    for mode, table in states.items():
        (folder / f"{mode}.yaml").write_text(f"kind: plan\nmode: {mode}\ndarks: 4\nstates: {table}\n")
    (folder / "campaign.yaml").write_text(
        f"kind: campaign\nname: flats\nplans: {{drr: drr.yaml, stokes: stokes.yaml}}\nsamples: [{{name: red_sphere}}]\n"
        f"wavelengths_nm: [662]\nomega_deg: {list(OMEGAS)}\nexposure_s: 0.004\nreferences:\n"
        "  - {sample: {kind: air, name: air}, omega_deg: 180, modes: [drr], every: 2}\n"
        "  - {sample: {name: white_diffuser}, omega_deg: 20, modes: [drr, stokes], every: 2, role: flat}\n"
    )
    arguments = ["--campaign", folder / "campaign.yaml", "--rig", folder / "rig.yaml", "--out", folder, "--yes"]
    assert exit_code(main, *arguments) == 0
    return folder / "flats"


@pytest.fixture(scope="module")
def products(campaign, configs) -> Path:
    """Folder of the products of `process campaign`."""
    from processing.commands.application import main

    files = [
        "--geometry",
        configs / "geometries/one_inch_sphere.yaml",
        "--material",
        configs / "materials/red_print.yaml",
    ]
    assert exit_code(main, "campaign", campaign, *files) == 0
    return campaign / "campaign"


def m00_of(product: Path) -> np.ndarray:
    return MuellerImage.load(product).values[0, 0]


def unevenness(image: np.ndarray, truth: np.ndarray, good: np.ndarray) -> float:
    """Relative rms deviation of an image from the truth times a number."""
    ratio = image[good] / truth[good]
    return float(np.std(ratio) / np.mean(ratio))


def test_references_come_at_the_stated_intervals(campaign):
    names = [path.stem.split("_", 1)[1] for path in sorted(campaign.glob("*.h5"))]
    drr = [name for name in names if "drr" in name]
    assert [name.rsplit("_", 3)[0] for name in drr] == [
        *("air", "white_diffuser", "red_sphere", "red_sphere"),
        *("air", "white_diffuser", "red_sphere"),
    ]
    assert [name.rsplit("_", 3)[0] for name in names if "stokes" in name] == [
        *("white_diffuser", "red_sphere", "red_sphere"),
        *("white_diffuser", "red_sphere"),
    ]
    for path in campaign.glob("*white_diffuser*.h5"):
        with Capture(path) as capture:
            assert set(capture.role) == {"dark", "flat"}
            assert capture.column("saturated_fraction").max() < 1e-3


def test_campaign_products_use_the_nearest_flat(campaign, products):
    for name, flat in (("003_red_sphere_drr_662nm_omega40", "002"), ("007_red_sphere_drr_662nm_omega60", "006")):
        with Product(products / f"{name}.mueller.h5") as product:
            assert f"of {flat}_white_diffuser_drr" in product.facts["flat"]
            assert any(f"{flat}_white_diffuser" in i["path"] for i in product.steps[0].inputs if i["role"] == "flat")
    with Product(products / "012_red_sphere_stokes_662nm_omega60.stokes.h5") as product:
        assert "011_white_diffuser_stokes" in product.facts["flat"]


def test_mueller_image_is_rid_of_the_uneven_response(campaign, products, configs, tmp_path):
    truth = Scene.load(configs / "scenes/red_sphere.yaml").truth(60, 662, *SHAPE)
    name = "007_red_sphere_drr_662nm_omega60"
    good = truth.mask & (np.nan_to_num(truth.m00) > 0.1)
    without = Reduction(campaign / f"{name}.h5").make(tmp_path / "without.h5")
    with_flat = Reduction(campaign / f"{name}.h5", flat=(campaign,)).make(tmp_path / "with.h5")
    with Product(with_flat) as product:
        facts = product.facts
    assert "006_white_diffuser" in facts["flat"]
    assert unevenness(m00_of(without), truth.m00, good) > 0.05
    image = MuellerImage.load(with_flat)
    errors = (image.errors[0, 0] / image.values[0, 0])[good]
    noise = np.hypot(np.sqrt(np.mean(errors**2)), facts["flat_error_percent"] / 100)
    assert noise < 0.02
    assert unevenness(m00_of(with_flat), truth.m00, good) < 1.3 * noise
    np.testing.assert_array_equal(m00_of(products / f"{name}.mueller.h5"), m00_of(with_flat))


def test_linear_polarization_is_rid_of_the_uneven_response(campaign, products, configs, tmp_path):
    """Neighbours of a mosaic that respond differently look like polarization; the errors know what the flat leaves."""
    name = "012_red_sphere_stokes_662nm_omega60"
    scene = Scene.load(configs / "scenes/red_sphere.yaml")
    m = scene.mueller_image(60, 662, *SHAPE)
    with np.errstate(invalid="ignore"):
        truth = (m[..., 1, 0] + m[..., 1, 1]) / (m[..., 0, 0] + m[..., 0, 1])
    inside = binary_erosion(scene.truth(60, 662, *SHAPE).mask, iterations=6)
    pull = {}
    for label, flat in (("without", ()), ("with", (campaign,))):
        out = Reduction(campaign / f"{name}.h5", flat=flat).make(tmp_path / f"{label}.h5")
        image = StokesImage.load(out)
        s0, s1 = image.values[:2]
        good = inside & (s0 > 0.1 * np.nanmax(s0))
        c = image.covariance
        variance = c[..., 1, 1] - 2 * s1 / s0 * c[..., 0, 1] + (s1 / s0) ** 2 * c[..., 0, 0]
        pull[label] = float(np.std(((s1 / s0 - truth) / np.sqrt(variance / s0**2))[good]))
    assert pull["without"] > 2
    assert pull["with"] == pytest.approx(1, abs=0.15)
