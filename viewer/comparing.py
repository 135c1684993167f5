"""Two captures, or two products, side by side: their difference or ratio, and that over its error."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response

from processing.errors import ProcessError
from processing.maps.intervals import moves_of
from processing.polarization.propagation import Derived
from processing.reduction.noise import NoiseModel
from processing.reduction.systematic import INPUTS, Systematic
from processing.reports.colours import ALL, LIGHT, SIGNED, ColourScale, period_deg, scale_of, steps
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage, difference_errors, element_gradient
from processing.storage.products.product import Product, is_lit, is_product
from processing.storage.products.provenance import content_of
from viewer.frames import chosen_frame
from viewer.pages import file_of, pages_of
from viewer.planes import Window, plane_response
from viewer.products import DERIVED, choices_of, is_whole, named, read_map, units_words

#: Errors at the ends of the scale of a difference over its error.
ERRORS_SHOWN = 5.0

#: [standard errors] Least size of a number that something is divided by: the error of the ratio is of first order.
DIVISOR = 5.0

#: Values and their standard errors, each (rows, columns).
Measured = tuple[NDArray[np.float32], NDArray[np.float32]]


def compare(request: Request) -> HTMLResponse:
    """The page that holds two files against each other."""
    pages, a, b = pages_of(request), file_of(request, "a"), file_of(request, "b")
    library = pages.library
    entries = [library.entry(library.name(path)) for path in (a, b)]
    choices, shape = _choices(a, b)
    return pages.draw(
        "compare.html",
        simulated=any(entry.simulated for entry in entries),
        mixed=entries[0].simulated != entries[1].simulated,
        entries=[(entry, pages.shown_at(entry)) for entry in entries],
        look={"choices": choices, "shape": shape},
        colours={name: steps(name) for name in ALL},
    )


def _choices(a: Path, b: Path) -> tuple[list[dict[str, Any]], tuple[int, int]]:
    """What can be compared: states of captures, maps of products. Raises ProcessError where nothing can."""
    if is_product(a) != is_product(b):
        raise ProcessError(f"{a.name} and {b.name}: a capture and a product have nothing in common to compare")
    if not is_product(a):
        with Capture(a) as capture_a, Capture(b) as capture_b:
            _same_shape(capture_a.frame_shape, capture_b.frame_shape)
            count = min(len(capture_a.done), len(capture_b.done))
            roles = capture_a.role[:count]
            choices = states_to_choose(capture_a)[:count]
            return sorted(choices, key=lambda c: roles[c["state"]] == "dark"), capture_a.frame_shape
    with Product(a) as first, Product(b) as second:
        _same_shape(first.shape, second.shape)
        available = {(c["name"], c["index"]) for c in choices_of(second)}
        return [c for c in choices_of(first) if (c["name"], c["index"]) in available], first.shape


def states_to_choose(capture: Capture) -> list[dict[str, Any]]:
    """The states done of a capture, as `chosen_frame` reads them."""
    return [
        {"label": f"state {number}, {role}", "state": k}
        for k, (number, role) in enumerate(zip(capture.done, capture.role, strict=True))
    ]


def queried_map(product: Product, query: Any) -> tuple[str, int]:
    """Dataset or derived quantity, and the number of it."""
    return (query["name"], 0) if _is_derived(product, query) else named(product, query)


def _is_derived(product: Product, query: Any) -> bool:
    return is_whole(product) and query.get("name") in DERIVED


def _same_shape(a: tuple[int, int], b: tuple[int, int]) -> None:
    if a != b:
        raise ProcessError(f"images of {a[1]} x {a[0]} and {b[1]} x {b[0]} pixels cannot be compared pixel by pixel")


def difference(request: Request) -> Response:
    """Four pictures of one window: a, b, a - b, and that over its standard error, of noise and instrument together.

    With `ratio` in the query a / b - 1 takes the place of a - b.
    """
    a, b, query = file_of(request, "a"), file_of(request, "b"), request.query_params
    is_ratio = bool(query.get("ratio"))
    if is_product(a):
        with Product(a) as first, Product(b) as second:
            _same_shape(first.shape, second.shape)
            window = Window.parse(query, first.shape, most=640)
            plane_a, plane_b = (product_values(product, query, window) for product in (first, second))
            slopes = _slopes(plane_a, plane_b, is_ratio)
            shared = _shared_errors(first, second, query, window, slopes=slopes)
            systematic = _systematic_errors(first, second, query, window, slopes=slopes)
            name, index = queried_map(first, query)
            units = "" if name == "mueller" or name in DERIVED else first.units(name)
            scale = scale_of("m00" if name == "mueller" and index == 0 else name, units, plane_a[0])
    elif is_ratio:
        raise ProcessError("counts contain the black level and have no ratio; reduce the captures and compare products")
    else:
        shared, systematic = None, np.zeros(())
        with Capture(a) as early, Capture(b) as late:
            _same_shape(early.frame_shape, late.frame_shape)
            window = Window.parse(query, early.frame_shape, most=640)
            plane_a, plane_b = (capture_values(capture, query, window) for capture in (early, late))
            slopes = _slopes(plane_a, plane_b, is_ratio)
            name, units, scale = None, "counts", ColourScale(LIGHT, *_ends(plane_a[0]))
    period = None if name is None else period_deg(name, units)
    if is_ratio and period is not None:
        raise ProcessError(f"{name} is an angle: two angles have a difference and no ratio")
    deviation = (plane_a[0] - plane_b[0]) * slopes[0]
    if period is not None:
        deviation = (deviation + period / 2) % period - period / 2
    noise = np.hypot(slopes[0] * plane_a[1], slopes[1] * plane_b[1]) if shared is None else shared
    with np.errstate(divide="ignore", invalid="ignore"):
        significance = deviation / np.hypot(noise, systematic)
    # An unlit pixel has no deviation, and an arbitrary error.
    is_compared = np.isfinite(deviation)
    wide = scale_of("deviation", "", deviation)
    scales = [scale, scale, wide, ColourScale(SIGNED, -ERRORS_SHOWN, ERRORS_SHOWN)]
    return plane_response(
        window,
        np.stack([plane_a[0], plane_b[0], deviation, significance]).astype(np.float32),
        scales=[{"colours": s.colours, "low": s.low, "high": s.high} for s in scales],
        units=units_words(units),
        rms=_rms(deviation),
        rms_noise=_rms(np.where(is_compared, noise, np.nan)),
        rms_systematic=_rms(np.where(is_compared, systematic, np.nan)),
        rms_over=_rms(significance),
    )


def _slopes(a: Measured, b: Measured, is_ratio: bool) -> NDArray[np.floating]:
    """Derivatives (2, rows, columns) of a - b by a and -b, or of a / b; NaN where b is hardly different from zero."""
    if not is_ratio:
        return np.ones((2, *a[0].shape))
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(np.abs(b[0]) < DIVISOR * b[1], np.nan, 1 / b[0].astype(float))
    return np.stack([inverse, a[0] * inverse**2])


def _rms(values: NDArray[np.floating]) -> float | None:
    valid = values[np.isfinite(values)].astype(float)
    return float(np.sqrt(np.mean(valid**2))) if valid.size else None


def _ends(counts: NDArray[np.float32]) -> tuple[float, float]:
    low, high = float(np.nanmin(counts)), float(np.nanmax(counts))
    return low, max(high, low + 1)


def product_values(product: Product, query: Any, window: Window) -> Measured:
    """The map of a product that a request chooses, in a window, with its standard errors, NaN where unknown."""
    name, index = queried_map(product, query)
    if _is_derived(product, query):
        image = _image(product, window)
        values, gradient, *_ = _derived(image, name)
        lit = is_lit(image.values[0, 0], image.errors[0, 0])
        planes = (np.where(lit, values, np.nan), np.sqrt(image.variance_of(gradient)))
        return planes[0].reshape(window.shape).astype(np.float32), planes[1].reshape(window.shape).astype(np.float32)
    if name == "mueller":
        elements, errors = (
            window.every(product.get(dataset, window.rows)).reshape(16, *window.shape).astype(np.float32)
            for dataset in ("mueller", "mueller_errors")
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            m00 = np.where(is_lit(elements[0], errors[0]), elements[0], np.nan)
            return (elements[0], errors[0]) if index == 0 else (elements[index] / m00, errors[index] / m00)
    values = read_map(product, name, index, window)
    if f"{name}_errors" not in product.names:
        return values, np.full_like(values, np.nan)
    return values, read_map(product, f"{name}_errors", index, window)


def _shared_errors(
    first: Product, second: Product, query: Any, window: Window, *, slopes: NDArray[np.floating]
) -> NDArray[np.floating] | None:
    """Errors of a difference or ratio of products of one capture, which share its noise; None of two captures.

    NaN where the share is not known: maps of which a product holds no gradient.
    """
    inputs = [p.steps[0].inputs if p.steps else () for p in (first, second)]
    captures = [[content_of(i) for i in every if i.get("role") == "capture"] for every in inputs]
    if captures[0] != captures[1] or not any(captures[0]):
        return None
    name, index = queried_map(first, query)
    if not (name == "mueller" or _is_derived(first, query)) or not first.kind == second.kind == "mueller":
        return np.full(window.shape, np.nan)
    images = [_image(product, window) for product in (first, second)]
    gradients = [element_gradient(i, index) if name == "mueller" else _derived(i, name).gradient for i in images]
    by_element = [g * s.reshape(*g.shape[:-1], 1) for g, s in zip(gradients, slopes, strict=True)]
    return difference_errors(images, by_element).reshape(window.shape)


def _systematic_errors(
    first: Product, second: Product, query: Any, window: Window, *, slopes: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Error of a difference or ratio by the instruments' uncertainties, (rows, columns).

    Products with the same uncertain inputs are of one instrument: its error leaves the difference as far as it moves
    both alike. Where only the size of both errors is known, they add.
    """
    (move_a, a), (move_b, b) = (_shifts(product, query, window) for product in (first, second))
    slope_a, slope_b = slopes
    a, b = a * np.abs(slope_a), b * np.abs(slope_b)
    if first.facts.get(INPUTS) != second.facts.get(INPUTS):
        return np.asarray(np.hypot(a, b))
    if move_a is None or move_b is None:
        return np.asarray(a + b)
    return np.asarray(np.sqrt(np.square(move_a * slope_a - move_b * slope_b).sum(axis=0)))


def _shifts(product: Product, query: Any, window: Window) -> tuple[NDArray[np.floating] | None, NDArray[np.floating]]:
    """Shifts of a map by each uncertain input of the instrument (D, rows, columns), if known, and their size."""
    name, index = queried_map(product, query)
    shifts = None
    if product.kind == "mueller" and (name == "mueller" or _is_derived(product, query)):
        systematic = Systematic.of_product(product)
        if systematic is not None:
            image = _image(product, window)
            slope = element_gradient(image, index) if name == "mueller" else _derived(image, name).gradient
            shifts = np.einsum("dixy,xyi->dxy", moves_of(systematic, image), slope).reshape(-1, *window.shape)
    elif f"{name}_directions" in product.names:
        shifts = window.every(product.get(f"{name}_directions", window.rows))
    if shifts is not None:
        return shifts, np.sqrt(np.square(shifts).sum(axis=0))
    if f"{name}_systematic" not in product.names:
        return None, np.zeros(window.shape)
    size = read_map(product, f"{name}_systematic", index, window)
    return None, size / read_map(product, name, 0, window) if name == "mueller" else size


def _image(product: Product, window: Window) -> MuellerImage:
    """The pixels of a window, as rows of one."""
    rows, columns = (np.arange(part.start, part.stop, window.step) for part in (window.rows, window.columns))
    pixels = ((rows - window.rows.start)[:, None] * product.shape[1] + columns).reshape(-1)
    return MuellerImage.of(product, window.rows).at(pixels)


def _derived(image: MuellerImage, name: str) -> Derived:
    return DERIVED[name](image.matrices.astype(float))[name]


def capture_values(capture: Capture, query: Any, window: Window) -> Measured:
    """Counts of the state that a request chooses in a window, with the noise of light and camera."""
    state, channel = chosen_frame(capture, query)
    counts = window.mean(capture.frames(state, window.rows)[channel])
    detector = capture.header.detector
    noise = NoiseModel.of(detector, integer=capture.integer_counts)
    if noise is None:
        return counts, np.full_like(counts, np.nan)
    signal = np.maximum(counts - detector.black_level_counts, 0)
    return counts, np.sqrt((noise.slope * signal + noise.read + noise.rounding) / window.step**2)
