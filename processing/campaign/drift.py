"""How an instrument changed between two captures of one sample, and the table of all checks since."""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.stats import norm

from processing.errors import ProcessError
from processing.maps.means import Region, mean_of
from processing.steps.file_step import Progress
from processing.steps.reduction import reduce_or_open
from processing.storage.captures.capture import Capture
from processing.storage.products.product import Product
from processing.whole_file import whole_file

#: Tiles along each side of the frame that are compared.
TILES = 4
#: Chance that noise alone makes a change anywhere.
FALSE_ALARM = 0.01
LIGHT = ("m00", "s0")


@dataclass(frozen=True)
class Changed:
    """Change of an element over m00 (or S0) in a part of the frame, with its standard error by noise."""

    name: str
    value: float
    error: float
    region: Region


@dataclass(frozen=True)
class Change:
    """Changes since the reference.

    Attributes
    ----------
    start_time, capture : of the capture that is compared.
    light : relative change of m00 over the frame.
    frame : of the elements over the frame.
    largest : of those beyond noise and tolerance; without any, of all.
    count, tests : elements in tiles beyond noise and tolerance, and all.
    """

    start_time: str
    capture: str
    light: Changed
    frame: tuple[Changed, ...]
    largest: Changed
    count: int
    tests: int
    simulated: bool


def compare(
    capture: Path, reference: Path, instrument: Path | None, tolerance: float, *, progress: Progress | None = None
) -> Change:
    """Compare M/m00 of two captures of one sample in tiles; what the instrument does to both does not count.

    Raises ProcessError: the captures differ in sample, wavelength, frame or origin, or have no pixel in common.
    """
    _require_alike(capture, reference)
    products = [reduce_or_open(path, instrument, progress).path for path in (capture, reference)]
    shapes = []
    for path in products:
        with Product(path) as product:
            shapes.append(product.shape)
    if shapes[0] != shapes[1]:
        raise ProcessError(f"{capture} has {shapes[0]} pixels, {reference} {shapes[1]}. Give captures of one frame.")
    rows, columns = (_parts(size) for size in shapes[0])
    changes = []
    for region in ((r, c) for r in rows for c in columns):
        try:
            changes += _changes(products, region)[1:]
        except ProcessError:
            # No pixel of this tile can be used.
            continue
    tests = [change for change in changes if change.error > 0 and np.isfinite(change.value)]
    if not tests:
        raise ProcessError(f"{capture} and {reference} have no pixel in common that can be used.")
    limit = norm.isf(FALSE_ALARM / 2 / len(tests))
    beyond = [change for change in tests if abs(change.value) > max(limit * change.error, tolerance)]
    light, *frame = _changes(products, (slice(0, shapes[0][0]), slice(0, shapes[0][1])))
    with Capture(capture) as opened:
        started, simulated = opened.start_time, opened.simulated
    largest = max(beyond or tests, key=lambda change: abs(change.value))
    return Change(started, capture.name, light, tuple(frame), largest, len(beyond), len(tests), simulated)


def _parts(size: int) -> list[slice]:
    edges = np.unique(np.linspace(0, size, TILES + 1).astype(int)).tolist()
    return [slice(a, b) for a, b in pairwise(edges)]


def _changes(products: list[Path], region: Region) -> list[Changed]:
    """Relative change of the light, then the changes of the elements over it."""
    new, old = ({mean.name: mean for mean in mean_of([path], region, elements_only=True)} for path in products)
    light = next(name for name in LIGHT if name in new)
    level = old[light].value
    noise = float(np.hypot(new[light].u_noise, old[light].u_noise)) / level
    changes = [Changed(light, new[light].value / level - 1, noise, region)]
    for name in new:
        if name.endswith(("_over_m00", "_over_s0")) and name in old:
            error = float(np.hypot(new[name].u_noise, old[name].u_noise))
            changes.append(Changed(name.split("_")[0], new[name].value - old[name].value, error, region))
    return changes


def comparable(path: Path) -> dict[str, str]:
    """Properties that two compared captures share."""
    with Capture(path) as opened:
        header, origin = opened.header, "simulated" if opened.simulated else "measured"
    sample = header.sample.name or header.sample.kind
    return {"sample": sample, "wavelength": f"{header.wavelength_nm:g} nm", "origin": origin}


def _require_alike(capture: Path, reference: Path) -> None:
    new, old = comparable(capture), comparable(reference)
    for name in new:
        if new[name] != old[name]:
            raise ProcessError(
                f"{capture}: {name} {new[name]}, but {reference}: {old[name]}. "
                "Give a capture of the same sample as --reference."
            )


def keep(change: Change, reference: Path) -> Path:
    """Add a check to the table of its reference, in the order of time and each capture once; returns the table."""
    path = reference.with_suffix(".checks.csv")
    rows: dict[str, Mapping[str, str]] = {row["capture"]: row for row in read_checks(path)} if path.exists() else {}
    row = {"start_time": change.start_time, "capture": change.capture}
    row |= {"verdict": "changed" if change.count else "unchanged", "light_percent": f"{100 * change.light.value:.4g}"}
    for element in change.frame:
        row |= {element.name: f"{element.value:.4g}", f"{element.name}_error": f"{element.error:.2g}"}
    rows[change.capture] = row
    with whole_file(path) as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(row))
        writer.writeheader()
        writer.writerows(sorted(rows.values(), key=lambda r: r["start_time"]))
    return path


def read_checks(table: Path) -> list[dict[str, str]]:
    """Rows of the table of checks, oldest first."""
    with table.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))
