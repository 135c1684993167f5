"""Mueller products from and to AxoStep's Mueller files."""

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from processing.doors import require_place
from processing.storage.captures.schema import CaptureHeader
from processing.storage.formats.axostep import AxoStepError, MuellerFile, read_mueller_file, write_mueller_file
from processing.storage.products.images import MUELLER_PLANES, require_all_elements
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Product, Step, file_identity
from processing.storage.products.product_writer import ProductWriter
from processing.storage.products.provenance import made_of


def product_of_axostep(
    source: Path, out: Path, wavelength_nm: float | None, omega_deg: float | None, *, overwrite: bool
) -> tuple[list[str], bool]:
    """Write a Mueller product with the image of a .cmmi or .bmmi file, unless `out` is exactly that product.

    Returns what was found in the file, in words, and whether the product existed. Raises AxoStepError: the file cannot
    be read, or nothing says the wavelength.
    """
    if source.suffix.lower() not in (".cmmi", ".bmmi"):
        raise AxoStepError(f"{source}: expected a .cmmi or .bmmi file; raw .rmmd files go to `process import --stack`")
    image = read_mueller_file(source)
    nm = wavelength_nm if wavelength_nm is not None else image.metadata.get("wavelength_nm", 0.0)
    if not 100 < nm < 30_000:
        raise AxoStepError(f"{source} says a wavelength of {nm:g} nm. Give the true one with --wavelength-nm.")
    header = CaptureHeader(
        title=source.name,
        simulated=False,
        mode="axostep",
        wavelength_nm=nm,
        omega_deg=omega_deg,
        versions={"umov": version("umov")},
    )
    rows, columns = image.mueller.shape[-2:]
    step = Step(
        "from-axostep",
        {
            **{"source": source.name, "wavelength_nm": nm, "omega_deg": omega_deg},
            **{"header_words": image.header_words, "metadata": image.metadata, "date": image.date},
        },
        (file_identity(source, "source"),),
    )
    date = f", {image.date:%Y-%m-%d %H:%M} GMT" if image.date else ""
    lines = [
        f"{columns} x {rows} pixels, {nm:g} nm{date}, {len(image.reduced)} reduced parameters (not taken over)",
        f"header of {image.header_words} words" + (" as the lab's reader expects" if image.header_words == 5 else ""),
    ]
    if not overwrite and out.is_file() and made_of(out) == step.made_of:
        return lines, True
    nothing = np.full((rows, columns), np.nan, np.float32)
    finite = np.isfinite(image.mueller).all(axis=(0, 1))
    facts: dict[str, Any] = {
        "method": "as in the file",
        "weighted": False,
        "warnings": ["the file holds no standard errors and no raw intensities"],
    }
    with ProductWriter(
        out, "mueller", header, (rows, columns), planes=MUELLER_PLANES, steps=(step,), overwrite=overwrite
    ) as writer:
        # One intensity an element, whose noise is not known: readers of products then give NaN as standard error.
        writer.array("measurement_matrix", np.eye(16), "", "identity: the file holds elements, not intensities")
        for name in ("noise_slope", "noise_floor"):
            writer.array(name, np.full(16, np.nan), "count", "not known")
        writer.write(
            slice(0, rows),
            mueller=image.mueller,
            mueller_errors=np.full((4, 4, rows, columns), np.nan, np.float32),
            residual_rms=nothing,
            pixel_flags=np.where(finite, 0, np.uint8(Mask.NOT_FINITE)).astype(np.uint8),
        )
        writer.seal(facts)
    return lines, False


def axostep_of_product(source: Path, out: Path, overwrite: bool) -> None:
    """Write the Mueller image of a product as a .bmmi or .cmmi file (without reduced parameters, which are AxoStep's).

    Raises
    ------
    ProcessError : the target exists, or has another ending.
    ProductError : the source is no Mueller product.
    """
    if out.suffix.lower() not in (".cmmi", ".bmmi"):
        raise AxoStepError(f"{out}: AxoStep's Mueller images end in .cmmi or .bmmi")
    require_place(out, overwrite)
    with Product(source) as product:
        require_all_elements(product)
        values, nm = product.get("mueller").astype(np.float32), product.header.wavelength_nm
    empty = np.empty((0, *values.shape[-2:]), np.float32)
    write_mueller_file(out, MuellerFile(values, empty, {"wavelength_nm": nm}))
