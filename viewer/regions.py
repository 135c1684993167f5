"""Named regions of the images of a folder, and the values of an image in each of them."""

import csv
import io
import re
import threading
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from processing.errors import ProcessError
from processing.maps.means import mean_of
from processing.maps.stokes_vector import is_stokes_vector
from processing.reflectance.shared_noise import shared_variance
from processing.reports.colours import period_deg
from processing.section import Section
from processing.storage.captures.capture import Capture
from processing.storage.products.images import neighbour_correlation
from processing.storage.products.product import Product, is_product
from viewer.comparing import capture_values, product_values, queried_map, states_to_choose
from viewer.library import Library, NotHere
from viewer.pages import fields_of, file_of, pages_of
from viewer.planes import Window
from viewer.probing import MOST, Region, finite
from viewer.products import choices_of, units_words
from viewer.side_files import read_side_file, write_side_file

#: Name of the file, in the folder of the application's own files.
FILE = "regions.json"
#: Bars of a histogram at most.
BARS = 40
#: A name is safe in a file name and in a spreadsheet.
NAME = re.compile(r"\w[\w .()+-]{0,39}")
COLUMNS = ("region", "quantity", "unit", "value", "error", "systematic", "spread", "pixels", "x0", "x1", "y0", "y1")

_lock = threading.Lock()


class NamedRegion(Section):
    """Rows and columns of an image of so many (rows, columns), the first and the one after the last."""

    name: str = Field(pattern=rf"^{NAME.pattern}$")
    columns: tuple[int, int]
    rows: tuple[int, int]
    image: tuple[int, int]

    def on(self, shape: tuple[int, int]) -> Region | None:
        """The same place in an image, also of a whole number of times as many or as few pixels; None in others."""
        region = Region(slice(*self.rows), slice(*self.columns))
        if shape[0] * self.image[1] != shape[1] * self.image[0]:
            return None
        if shape[0] % self.image[0] == 0:
            return region.enlarged(shape[0] // self.image[0])
        return region.reduced(self.image[0] // shape[0]) if self.image[0] % shape[0] == 0 else None


class _RegionsFile(BaseModel):
    model_config = ConfigDict(extra="forbid")

    regions: list[NamedRegion] = []


def load_regions(library: Library) -> list[NamedRegion]:
    """The regions of a folder, in the order in which they were named. Raises ProcessError for a damaged file."""
    return read_side_file(library, FILE, _RegionsFile).regions


async def keep_region(request: Request) -> JSONResponse:
    """Name a region of an image; a region of that name moves."""
    fields = await fields_of(request)
    return await run_in_threadpool(_keep_region, pages_of(request).library, fields)


def _keep_region(library: Library, fields: dict[str, str]) -> JSONResponse:
    shape = MeasuredImage(library.path(fields.get("file", ""))).shape
    place, name = Region.parse(fields, shape), fields.get("name", "").strip()
    if not NAME.fullmatch(name):
        raise ProcessError("a region has a name of up to 40 letters, digits, spaces and signs . ( ) + - _")
    columns, rows = ((part.start, part.stop) for part in (place.columns, place.rows))
    new_region = NamedRegion(name=name, columns=columns, rows=rows, image=shape)
    with _lock:
        by_name = {region.name: region for region in load_regions(library)} | {name: new_region}
        write_side_file(library, FILE, _RegionsFile(regions=list(by_name.values())))
    return JSONResponse({"name": name})


async def drop_region(request: Request) -> JSONResponse:
    """Forget a region. Raises NotHere."""
    fields = await fields_of(request)
    return await run_in_threadpool(_drop_region, pages_of(request).library, fields.get("name", ""))


def _drop_region(library: Library, name: str) -> JSONResponse:
    with _lock:
        saved = load_regions(library)
        if all(region.name != name for region in saved):
            raise NotHere(f"{name}: there is no such region")
        write_side_file(library, FILE, _RegionsFile(regions=[region for region in saved if region.name != name]))
    return JSONResponse({"name": name})


def regions(request: Request) -> JSONResponse:
    """One quantity of an image in the region that the request names by x0 and y0, and in every named one."""
    path, query = file_of(request), request.query_params
    image = MeasuredImage(path)
    areas = [("", Region.parse(query, image.shape))] if "x0" in query else []
    areas += _named_areas(pages_of(request).library, image.shape)
    return JSONResponse({"regions": [image.row(name, region, query) for name, region in areas]})


def table(request: Request) -> Response:
    """Every quantity of an image in every named region, as comma-separated text."""
    path = file_of(request)
    image = MeasuredImage(path)
    text = io.StringIO()
    text.write(f"# {path.name}\n" + ("# SIMULATED data\n" if image.simulated else ""))
    lines = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    lines.writeheader()
    for name, region in _named_areas(pages_of(request).library, image.shape):
        for choice in image.choices:
            row = image.row(name, region, {"index": 0} | choice)
            lines.writerow({**row, "region": name, "quantity": choice["label"]})
    file = re.sub(r"[^\w.-]", "_", path.stem, flags=re.ASCII)
    return Response(
        text.getvalue(),
        media_type="text/csv",
        headers={"Content-Disposition": f'attachment; filename="{file}.regions.csv"'},
    )


def _named_areas(library: Library, shape: tuple[int, int]) -> list[tuple[str, Region]]:
    return [(region.name, area) for region in load_regions(library) if (area := region.on(shape)) is not None]


@dataclass(frozen=True)
class _Pixels:
    """One quantity of the pixels of a region; without errors where they are not known.

    Attributes
    ----------
    period : of an orientation.
    correlation : of the noise of neighbours.
    mean : value, error and systematic error of a mean that is better known than by that of the pixels.
    """

    values: NDArray[np.float64]
    errors: NDArray[np.float64]
    units: str
    period: float | None
    correlation: NDArray[np.float64]
    systematic: NDArray[np.float64] | None = None
    mean: tuple[float, float, float] | None = None


class MeasuredImage:
    """A capture or a product, of whose regions pages ask."""

    def __init__(self, path: Path) -> None:
        self._path = path
        if is_product(path):
            with Product(path) as product:
                self.shape, self.simulated = product.shape, product.simulated
                self.choices = choices_of(product)
        else:
            with Capture(path) as capture:
                self.shape, self.simulated = capture.frame_shape, capture.simulated
                self.choices = states_to_choose(capture)

    def row(self, name: str, region: Region, query: Any) -> dict[str, Any]:
        """Mean, spread, histogram and profiles of a region, without the pixels that have no value."""
        if region.pixels > MOST:
            raise ProcessError(f"{region} is more than is read at once; draw a smaller one")
        pixels = self._pixels(region, query)
        is_finite = np.isfinite(pixels.values)
        count = int(is_finite.sum())
        (x0, x1), (y0, y1) = ((part.start, part.stop) for part in (region.columns, region.rows))
        row = {"name": name, "where": str(region), "x0": x0, "x1": x1, "y0": y0, "y1": y1, "pixels": count}
        row |= {"unit": units_words(pixels.units), "value": None, "error": None, "systematic": None, "spread": None}
        if not count:
            return row | {"histogram": {"edges": [], "pixels": []}, "columns": [], "rows": []}
        mean = float(_mean(pixels.values[is_finite], pixels.period, 0))
        deviation = _wrap(pixels.values - mean, pixels.period)
        value, error, systematic = pixels.mean or (mean, _error(pixels, is_finite), _systematic(pixels, is_finite))
        edges = _edges(pixels.values[is_finite] if pixels.period is None else mean + deviation[is_finite])
        return row | {
            "value": finite(value),
            "error": finite(error),
            "systematic": finite(systematic),
            "spread": finite(deviation[is_finite].std(ddof=1)) if count > 1 else None,
            "histogram": {
                "edges": edges.tolist(),
                "pixels": np.histogram(mean + deviation[is_finite], edges)[0].tolist(),
            },
            "columns": finite(_mean(pixels.values, pixels.period, 0)),
            "rows": finite(_mean(pixels.values, pixels.period, 1)),
        }

    def _pixels(self, region: Region, query: Any) -> _Pixels:
        window, uncorrelated = Window(region.rows, region.columns, 1), np.ones((1, 1))
        if not is_product(self._path):
            with Capture(self._path) as capture:
                counts, errors = capture_values(capture, query, window)
            return _Pixels(counts.astype(float), errors.astype(float), "count", None, uncorrelated)
        with Product(self._path) as product:
            name, index = queried_map(product, query)
            values, errors = product_values(product, query, window)
            units = _units(product, name, index)
            systematic = None
            if f"{name}_systematic" in product.names and name != "mueller":
                planes = product.get(f"{name}_systematic", region.rows)
                systematic = planes.reshape(-1, *planes.shape[-2:])[index][:, region.columns].astype(float)
            correlation = neighbour_correlation(product)
            kind, light = product.kind, is_stokes_vector(product)
        mean = None
        if kind in ("mueller", "stokes"):
            means = _means(self._path, self._path.stat().st_mtime_ns, (*_ends(region.rows), *_ends(region.columns)))
            mean = means.get(_element(index, light) if name == "mueller" else name)
        period = period_deg(name, units)
        return _Pixels(values.astype(float), errors.astype(float), units, period, correlation, systematic, mean)


def _units(product: Product, name: str, index: int) -> str:
    """Unit of a map; elements over m00 and quantities that the product does not hold have none."""
    is_ratio = name == "mueller" and index > 0
    return "" if is_ratio or name not in product.names else product.units(name)


def _element(index: int, light: bool) -> str:
    """How the mean of an element over m00 is called."""
    if light:
        return "s0" if index == 0 else f"s{index // 4}_over_s0"
    return "m00" if index == 0 else f"m{index // 4}{index % 4}_over_m00"


def _ends(part: slice) -> tuple[int, int]:
    return part.start, part.stop


@lru_cache(maxsize=256)
def _means(path: Path, changed: int, place: tuple[int, int, int, int]) -> dict[str, tuple[float, float, float]]:
    """Means of a region by name, with their errors; none where no pixel can be used."""
    try:
        means = mean_of([path], (slice(*place[:2]), slice(*place[2:])))
    except ProcessError:
        return {}
    # Without an uncertain input the instrument's share is not zero, but not stated.
    return {mean.name: (mean.value, mean.u_noise, mean.u_systematic if mean.budget[1:] else np.nan) for mean in means}


def _mean(values: NDArray[np.float64], period: float | None, axis: int) -> NDArray[np.float64]:
    """Mean of the finite values along an axis; of orientations, that of 1 and 179 degrees is 0 and not 90."""
    is_finite = np.isfinite(values)
    filled = np.where(is_finite, values, 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        if period is None:
            return np.asarray(filled.sum(axis=axis) / is_finite.sum(axis=axis))
        turns = np.where(is_finite, np.exp(2j * np.pi * filled / period), 0).sum(axis=axis) / is_finite.sum(axis=axis)
    return np.asarray(np.angle(turns) / (2 * np.pi) * period % period)


def _wrap(off: NDArray[np.float64], period: float | None) -> NDArray[np.float64]:
    return off if period is None else np.asarray((off + period / 2) % period - period / 2)


def _error(pixels: _Pixels, good: NDArray[np.bool_]) -> float:
    """Standard error of the mean by the noise of each pixel; NaN where one is not known."""
    if not np.isfinite(pixels.errors[good]).all():
        return float("nan")
    total = shared_variance(np.where(good, 0, -1), pixels.errors, pixels.correlation)[good].sum()
    return float(np.sqrt(total) / good.sum())


def _systematic(pixels: _Pixels, good: NDArray[np.bool_]) -> float:
    """An error that all pixels share does not average."""
    return float("nan") if pixels.systematic is None else float(pixels.systematic[good].mean())


def _edges(values: NDArray[np.float64]) -> NDArray[np.float64]:
    low, high = float(values.min()), float(values.max())
    is_whole = bool((values == np.round(values)).all())
    if is_whole:
        # Whole counts: bars of a whole number of counts each.
        wide = max(1, -(-int(high - low + 1) // BARS))
        return np.arange(low, high + wide + 1, wide) - 0.5
    return np.linspace(low, high if high > low else low + 1, BARS + 1)
