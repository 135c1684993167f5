"""Answers to requests of a page about a pixel or a region."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from starlette.requests import Request
from starlette.responses import JSONResponse

from processing.errors import ProcessError
from processing.maps.extrapolation import EXTRAPOLATED
from processing.maps.quantities import image_of
from processing.reflectance.shared_noise import shared_variance
from processing.reports.colours import period_deg
from processing.storage.captures.capture import Capture
from processing.storage.products.images import neighbour_correlation
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import COMPANIONS, Product
from viewer.frames import chosen_frame
from viewer.library import Library, input_of
from viewer.mosaic_probing import SuperPixelReducer
from viewer.pages import file_of, pages_of
from viewer.probing import PixelReducer, Region, curve, finite, matrix, raw_curve


def curve_of(request: Request) -> JSONResponse:
    """Intensities of a pixel or a region of a capture, with the fitted curve where there can be one."""
    return JSONResponse(_capture_probe(file_of(request), request.query_params))


def _capture_probe(path: Path, query: Any) -> dict[str, Any]:
    with Capture(path) as capture:
        region = Region.parse(query, capture.frame_shape)
        raw = raw_curve(capture, region, chosen_frame(capture, {"channel": query.get("channel", 0)})[1])
        running = capture.status == "running"
    if running:
        return raw | {"told": "The capture is being taken; the fit comes when it is complete."}
    return raw | _fit(path, region, None)


def matrix_of(request: Request) -> JSONResponse:
    """Mueller matrix of a pixel or a region of a capture, and its decompositions."""
    path = file_of(request)
    with Capture(path) as capture:
        region = Region.parse(request.query_params, capture.frame_shape)
        if capture.status == "running":
            raise ProcessError("the capture is being taken")
    return JSONResponse({"where": str(region)} | _matrix(path, region, None))


def _matrix(path: Path, region: Region, instrument: Path | None) -> dict[str, Any]:
    """Nothing where the super-pixels of a polarization camera have a Stokes vector."""
    reducer = reducer_of(path, instrument)
    return {} if isinstance(reducer, SuperPixelReducer) else {"matrix": matrix(reducer.image(region)[0])}


def _fit(path: Path, region: Region, instrument: Path | None) -> dict[str, Any]:
    try:
        reducer = reducer_of(path, instrument)
        if isinstance(reducer, SuperPixelReducer):
            fit = reducer.curve(region)
        else:
            fit = curve(reducer, region)
    except ProcessError as error:
        return {"told": f"No fit: {error}"}
    return {"fit": fit, "told": fit["told"]}


def reducer_of(path: Path, instrument: Path | None) -> PixelReducer | SuperPixelReducer:
    """What reduces single pixels of a capture, or super-pixels; kept while its files stay as they are."""
    changed = [p.stat().st_mtime_ns for p in (path, instrument) if p is not None]
    return _make_reducer(path, instrument, tuple(changed))


@lru_cache(maxsize=4)
def _make_reducer(path: Path, instrument: Path | None, changed: tuple[int, ...]) -> PixelReducer | SuperPixelReducer:
    with Capture(path) as capture:
        stokes = capture.reduces_to == "stokes"
    return SuperPixelReducer(path, instrument) if stokes else PixelReducer(path, instrument)


def of_product(request: Request) -> JSONResponse:
    """Values of a product at a pixel or a region, and its intensities if the capture is in the folder."""
    return JSONResponse(_product_probe(file_of(request), request.query_params, pages_of(request).library))


def _product_probe(path: Path, query: Any, library: Library) -> dict[str, Any]:
    with Product(path) as product:
        shape = product.shape
        region = Region.parse(query, shape)
        answer: dict[str, Any] = {"where": str(region), "planes": _planes(product, region), "told": ""}
        if "pixel_flags" in product.names:
            bits = product.get("pixel_flags", region.rows)[:, region.columns]
            answer["mask"] = Mask.words(int(bits.max())) if bits.any() else "valid"
        if product.kind in ("mueller", EXTRAPOLATED) and region.pixels == 1:
            image = image_of(product, region.rows)
            answer["matrix"] = matrix(image.at(np.array([region.columns.start])))
        source = capture_of(product, library)
    if source is None:
        return answer | {"told": "The capture behind this product is not in the folder."}
    path, instrument = source
    with Capture(path) as capture:
        # A Stokes image may have one pixel for each super-pixel.
        region = region.enlarged(capture.frame_shape[0] // shape[0])
        answer |= raw_curve(capture, region, 0) | {"where": answer["where"]}
    answer |= _fit(path, region, instrument)
    if "matrix" not in answer and "fit" in answer:
        answer |= _matrix(path, region, instrument)
    return answer


def _planes(product: Product, region: Region) -> list[dict[str, Any]]:
    entries, correlation = [], neighbour_correlation(product)
    for name in product.names:
        # The flags are given in words.
        if name.endswith((*COMPANIONS, "covariance")) or name in ("mueller", "pixel_flags"):
            continue
        values = product.get(name, region.rows)[..., region.columns]
        if values.size // region.pixels > 4:
            continue
        flat = values.reshape(-1, region.pixels).astype(float)
        errors = f"{name}_errors"
        entry = {"name": name, "units": product.units(name), "about": product.long_name(name)}
        with np.errstate(invalid="ignore"):
            entry["value"] = finite(_mean(flat, period_deg(name, product.units(name))))
            if errors in product.names:
                values_of = product.get(errors, region.rows)[..., region.columns].astype(float)
                values_of = values_of.reshape(-1, *values_of.shape[-2:])
                labels = np.zeros(values_of.shape[1:], int)
                # An error that is not known leaves that of the mean unknown.
                total = [shared_variance(labels, sigma, correlation).sum() + 0 * sigma.sum() for sigma in values_of]
                entry["error"] = finite(np.sqrt(total) / region.pixels)
            if f"{name}_systematic" in product.names:
                values_of = product.get(f"{name}_systematic", region.rows)[..., region.columns]
                entry["systematic"] = finite(values_of.reshape(-1, region.pixels).mean(axis=1, dtype=float))
        entries.append(entry)
    return entries


def _mean(values: NDArray[np.float64], period: float | None) -> NDArray[np.float64]:
    """Mean over the pixels of (planes, pixels); of orientations, that of 1 and 179 degrees is 0 and not 90."""
    if period is None:
        return np.asarray(values.mean(axis=1))
    turns = np.exp(2j * np.pi * values / period).mean(axis=1)
    return np.asarray(np.angle(turns) / (2 * np.pi) * period % period)


def capture_of(product: Product, library: Library) -> tuple[Path, Path | None] | None:
    """The capture that a product was reduced from, and the instrument file; None where it is not in the folder."""
    reductions = [step for step in product.steps if step.name == "reduce"]
    if not reductions:
        return None
    inputs = {str(i.get("role")): i for i in reductions[0].inputs}
    if "capture" not in inputs:
        return None
    path = Path(str(inputs["capture"].get("path")))
    if not library.holds(path):
        source = input_of(inputs["capture"], library.entries(), library.root)
        if source is None:
            return None
        path = library.root / source.name
    instrument = Path(str(inputs["instrument"].get("path"))) if "instrument" in inputs else None
    return path, instrument if instrument is not None and instrument.exists() else None
