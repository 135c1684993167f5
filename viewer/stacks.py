"""A region followed through the products of a folder: over the arm angle, the wavelength, the time or the sample."""

import csv
import io
from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response

from processing.commands.batch import natural
from processing.errors import ProcessError
from processing.labelled import taken_at
from processing.maps.region import parse_region
from processing.storage.products.product import Product
from viewer.library import Entry, NotHere
from viewer.pages import Pages, pages_of
from viewer.probing import Region
from viewer.products import choices_of
from viewer.regions import MeasuredImage, load_regions

#: Abscissas of a curve: the name of a column, and its label.
AXES = {"omega": "Ω", "nm": "wavelength", "time": "time", "sample": "sample"}
#: Products of one stack at most.
MOST_FILES = 1000
#: The region without a name: the middle half of the image, as `process mean` has it.
MIDDLE = "middle half of the image"
COLUMNS = (
    *("file", "sample", "nm", "omega", "time", "region", "quantity", "unit"),
    *("value", "error", "systematic", "spread", "pixels", "simulated"),
)


def stack(request: Request) -> HTMLResponse:
    """The page of the products of one kind: which quantity, in which region, over what."""
    pages, query = pages_of(request), request.query_params
    kinds = _kinds(pages)
    kind = query.get("kind", "") if query.get("kind") in kinds else next(iter(kinds), "")
    entries = _chosen(pages, kind, query.get("q", ""))
    choices: list[dict[str, Any]] = []
    if entries:
        with Product(pages.library.path(entries[0].name)) as product:
            choices = choices_of(product)
    varied = {name: len({_place(entry)[name] for entry in entries}) for name in ("omega", "nm", "sample")}
    most_varied = max(varied, key=lambda name: varied[name])
    return pages.draw(
        "stack.html",
        simulated=any(entry.simulated for entry in entries),
        mixed=len({entry.simulated for entry in entries}) > 1,
        kinds=kinds,
        kind=kind,
        words=query.get("q", ""),
        count=len(entries),
        choices=choices,
        places=[MIDDLE, *(region.name for region in load_regions(pages.library))],
        axes=AXES,
        # Without anything that differs these are repeats.
        over=most_varied if varied[most_varied] > 1 else "time",
    )


def stacked(request: Request) -> JSONResponse:
    """One quantity in one region of every product of a kind, in the order of their names."""
    points, reasons = _points(request)
    return JSONResponse({"points": points, "left_out": dict(Counter(reasons))})


def table(request: Request) -> Response:
    """The same as comma-separated text."""
    points, _ = _points(request)
    text = io.StringIO()
    if any(point["simulated"] for point in points):
        text.write("# SIMULATED data\n")
    lines = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    lines.writeheader()
    lines.writerows(points)
    headers = {"Content-Disposition": 'attachment; filename="stack.csv"'}
    return Response(text.getvalue(), media_type="text/csv", headers=headers)


def _kinds(pages: Pages) -> dict[str, int]:
    """Kinds of products of the folder and how many there are; Mueller and Stokes images first."""
    entries = [e for e in pages.library.entries() if e.kind not in ("capture", "unreadable") and pages.shown_at(e)]
    counts = Counter(e.kind for e in entries if e.header is not None)
    return dict(sorted(counts.items(), key=lambda item: (item[0] not in ("mueller", "stokes"), item[0])))


def _chosen(pages: Pages, kind: str, words: str) -> list[Entry]:
    terms = words.lower().split()
    matches = [e for e in pages.library.entries() if e.kind == kind and all(word in e.words for word in terms)]
    return sorted(matches, key=lambda e: natural(Path(e.name)))[:MOST_FILES]


def _place(entry: Entry) -> dict[str, Any]:
    header = entry.header
    nm, omega = (None, None) if header is None else (header.wavelength_nm, header.omega_deg)
    return {"sample": entry.sample, "nm": nm, "omega": omega}


def _points(request: Request) -> tuple[list[dict[str, Any]], list[str]]:
    """A point for each product, and why others have none."""
    pages, query = pages_of(request), request.query_params
    area_of = {area.name: area for area in load_regions(pages.library)}
    where = query.get("region", MIDDLE)
    if where != MIDDLE and where not in area_of:
        raise NotHere(f"{where}: there is no such region")
    name, index, label = query.get("name", ""), query.get("index", "0"), query.get("label", "")
    points: list[dict[str, Any]] = []
    reasons: list[str] = []
    for entry in _chosen(pages, query.get("kind", ""), query.get("q", "")):
        path = pages.library.path(entry.name)
        try:
            image, time = _open_image(path, path.stat().st_mtime_ns)
            region = Region(*parse_region(None, image.shape)) if where == MIDDLE else area_of[where].on(image.shape)
            if region is None:
                reasons.append(f"the image has another form than region {where}")
                continue
            row = image.row(where, region, {"name": name, "index": index})
        except ProcessError as error:
            reasons.append(str(error))
            continue
        place = {"file": entry.name, **_place(entry), "time": time, "simulated": entry.simulated}
        numbers = {key: row[key] for key in ("unit", "value", "error", "systematic", "spread", "pixels")}
        points.append({**place, "region": where, "quantity": label or name, **numbers})
    return points, reasons


@lru_cache(maxsize=MOST_FILES)
def _open_image(path: Path, changed: int) -> tuple[MeasuredImage, str]:
    with Product(path) as product:
        return MeasuredImage(path), taken_at(product)
