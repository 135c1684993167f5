"""Processing of the study's captures, with the same steps as the commands of `process` and `diagnose`."""

import os
import shutil
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

from paper_study.acquire import BENCH, CONFIGS, SHOWN_DEG

from processing.campaign.captures import find_captures
from processing.campaign.run import CampaignResult, ProcessedCampaign, compare_on_sphere
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument_file import write_instrument
from processing.diagnosis.search.result import Diagnosis
from processing.instrument.model import InstrumentModel
from processing.reflectance.tables import ScatteringTable
from processing.steps.maps import Extrapolation, Quantities, Xi0
from processing.steps.material import FittedMaterial, MaterialFitting
from processing.steps.reduction import reduce_or_open
from processing.storage.captures.capture import Capture
from processing.storage.products.product import Product
from processing.yaml_file import dump_yaml

SPHERE, BODY = CONFIGS / "geometries/one_inch_sphere.yaml", Path(__file__).parent / "body_geometry.yaml"
TABLE_I, RGB950 = CONFIGS / "materials/red_print.yaml", CONFIGS / "instruments/rgb950.yaml"
#: The true material of the bench; only the budget and the page use it, to separate the model's part.
TRUE_MATERIAL = BENCH / "material.yaml"
#: Arm angles of which at most so many go into a fit of the material, evenly chosen.
FITTED_ANGLES = 4

Say = Callable[[str], None]


@dataclass(frozen=True)
class SphereStudy:
    """The sphere three times: as the files say, found in the images, and with the bench's own material as well.

    `fits` holds fitted constants by wavelength, and by the images and the method that they come from. Products are in
    `folder`.
    """

    folder: Path
    as_told: CampaignResult
    registered: CampaignResult
    true_material: CampaignResult
    fits: dict[float, dict[str, FittedMaterial]]


@dataclass(frozen=True)
class BodyProducts:
    """The body at one wavelength: products of the Mueller polarimeter and of the Stokes camera."""

    mueller: Path
    quantities: Path
    xi0: Path
    extrapolated: Path
    extrapolated_quantities: Path


@dataclass(frozen=True)
class FaultStudy:
    """The same fault before and after `diagnose`: Mueller results, xi0 against the Stokes camera, the diagnosis."""

    before: CampaignResult
    after: CampaignResult
    result: Diagnosis
    xi0_percent: dict[str, dict[tuple[float, float], float]]


def study_sphere(captures: Path, out: Path, pool: Executor, say: Say) -> SphereStudy:
    """Reduce and compare everything, with less and less that is wrong."""
    say("sphere, as the files say")
    as_told = ProcessedCampaign(captures, out / "told", SPHERE, TABLE_I).run(pool)
    _link_products(out / "told", out / "registered")
    say("sphere, found in the images")
    registered = ProcessedCampaign(captures, out / "registered", SPHERE, TABLE_I, register=True).run(pool)
    geometries = {kind: out / f"geometry_{kind}.yaml" for kind in registered.views}
    for kind, path in geometries.items():
        path.write_text(dump_yaml(registered.views[kind]), encoding="utf-8")
    say("constants of the material, both ways")
    fits = _fits(captures, out / "registered", geometries)
    _link_products(out / "told", out / "true_material")
    say("sphere, found in the images, with the material as it is")
    true_material = ProcessedCampaign(
        captures, out / "true_material", geometries["mueller"], TRUE_MATERIAL, stokes_geometry=geometries["stokes"]
    ).run(pool)
    return SphereStudy(out / "told", as_told, registered, true_material, fits)


def study_body(captures: Path) -> dict[float, BodyProducts]:
    """Mueller image, eigenvalues, extrapolation and polarizer pairs of the body, by wavelength."""
    images: dict[float, dict[str, Path]] = {}
    for path, kind, nm, *_ in find_captures(captures)[0]:
        images.setdefault(nm, {})[kind] = reduce_or_open(path).path
    products = {}
    for nm, image in images.items():
        extrapolation = Extrapolation(image["stokes"], BODY, TABLE_I).found_or_made().path
        products[nm] = BodyProducts(
            mueller=image["mueller"],
            quantities=Quantities(image["mueller"]).found_or_made().path,
            xi0=Xi0(image["mueller"]).found_or_made().path,
            extrapolated=extrapolation,
            extrapolated_quantities=Quantities(extrapolation)
            .found_or_made(extrapolation.with_name(f"{extrapolation.stem}.quantities.h5"))
            .path,
        )
    return products


def study_fault(captures: Path, out: Path, healthy: SphereStudy, pool: Executor, *, say: Say) -> FaultStudy:
    """Compare as if nothing were wrong, ask `diagnose`, and compare again with the instrument file that it wrote."""
    say("sphere with the undeclared fault")
    before = ProcessedCampaign(captures, out / "before", SPHERE, TABLE_I).run(pool)
    say("diagnose")
    diagnosis, instrument = _diagnosed(captures, out)
    say("sphere, corrected")
    after = ProcessedCampaign(captures, out / "after", SPHERE, TABLE_I, instrument=instrument).run(pool)
    xi0 = {name: _xi0(result, healthy) for name, result in (("before", before), ("after", after))}
    return FaultStudy(before, after, diagnosis, xi0)


def _diagnosed(captures: Path, out: Path) -> tuple[Diagnosis, Path]:
    out.mkdir(parents=True, exist_ok=True)
    sources = []
    for path in sorted(captures.glob("*.h5")):
        with Capture(path) as capture:
            if capture.header.sample.kind == "air" or capture.header.omega_deg == SHOWN_DEG:
                sources.append(path)
    model = InstrumentModel.load(RGB950)
    judgement, _ = diagnose_captures(sources, model)
    target = out / "rgb950_diagnosed.yaml"
    target.unlink(missing_ok=True)
    write_instrument(target, model, judgement.diagnosis)
    return judgement.diagnosis, target


def _xi0(faulty: CampaignResult, healthy: SphereStudy) -> dict[tuple[float, float], float]:
    """RMSD of xi0, %, of the faulty Mueller polarimeter against the sound Stokes camera, by wavelength and Omega."""
    stokes = healthy.as_told.tables
    with Product(next(healthy.folder.glob("*.stokes.h5"))) as product:
        shape = product.shape
    rmsd = {}
    for row in faulty.rows:
        tables = [
            ScatteringTable.load(path)
            for path in (faulty.tables["mueller", row.wavelength_nm], stokes["stokes", row.wavelength_nm])
        ]
        view = healthy.as_told.views["stokes"]
        comparison = compare_on_sphere(tables[0], tables[1], view, row.omega_deg, shape=shape)
        rmsd[row.wavelength_nm, row.omega_deg] = comparison.get("xi0_percent", float("nan"))
    return rmsd


def _fits(captures: Path, products: Path, geometries: Mapping[str, Path]) -> dict[float, dict[str, FittedMaterial]]:
    by_kind: dict[tuple[float, str], list[tuple[float, Path]]] = {}
    for path, kind, nm, omega, *_ in find_captures(captures)[0]:
        by_kind.setdefault((nm, kind), []).append((omega, products / f"{path.stem}.{kind}.h5"))
    fits: dict[float, dict[str, FittedMaterial]] = {}
    for (nm, kind), images in by_kind.items():
        step = max(1, -(-len(images) // FITTED_ANGLES))
        sources = tuple(path for _, path in sorted(images)[::step])
        # Of Mueller images both ways that the paper's conclusions propose; Stokes images allow the second alone.
        for correlation in (False, True) if kind == "mueller" else (False,):
            fitting = MaterialFitting(sources, geometries[kind], "fitted red print", correlation)
            material = fitting.fitted()
            fits.setdefault(nm, {})[f"{kind} images by the {material.fit.method}"] = material
    return fits


def _link_products(source: Path, target: Path) -> None:
    """The images of one folder in another one too, where the next campaign finds them."""
    target.mkdir(parents=True, exist_ok=True)
    for path in source.glob("*.h5"):
        if not path.name.endswith(".table.h5") and not (target / path.name).exists():
            try:
                os.link(path, target / path.name)
            except OSError:
                shutil.copy2(path, target / path.name)
