"""A product: its maps with their standard errors and the valid mask, in the colours of print."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response

from processing.errors import ProcessError
from processing.maps.stokes_vector import is_stokes_vector
from processing.polarization import gradients
from processing.reports.colours import ALL, LIGHT, SIGNED, ColourScale, period_deg, scale_of, steps
from processing.reports.fact_words import fact_lines
from processing.storage.products.product import COMPANIONS, Product, is_lit
from processing.storage.products.provenance import steps_text
from viewer.frames import comparable_files
from viewer.library import inputs_of, outputs_of
from viewer.notes import Note, notes_of
from viewer.pages import file_of, pages_of
from viewer.planes import Window, plane_response

#: Kinds that hold Mueller matrices.
MATRICES = ("mueller", "extrapolated")
#: Quantities of M of a product that holds M alone.
DERIVED = {
    "depolarization_index": gradients.depolarization_index,
    "diattenuation_linear": gradients.diattenuation,
    "polarizance_linear": gradients.polarizance,
}

#: The map that a page opens on; default: that with the name of the kind.
FIRST = {"stokes": "s0", "quantities": "depolarization_index"}


def product(request: Request) -> HTMLResponse:
    """The page of a product."""
    pages, path = pages_of(request), file_of(request)
    library = pages.library
    entry, entries = library.entry(library.name(path)), library.entries()
    with Product(path) as opened:
        maps, choices = maps_of(opened), choices_of(opened)
        facts = [line for name, line in fact_lines(opened.facts).items() if name != "warnings"]
        provenance = steps_text(opened.steps)
        shape, kind = opened.shape, opened.kind
        matrices = kind in MATRICES and not is_stokes_vector(opened)
    return pages.draw(
        "product.html",
        simulated=entry.simulated,
        entry=entry,
        note=notes_of(library).get(entry.name, Note()),
        kind=kind,
        facts=facts,
        provenance=provenance,
        look={"maps": maps, "shape": shape, "matrices": matrices, "choices": choices},
        choices=choices,
        colours={name: steps(name) for name in ALL},
        sources=[
            (role, path, e, pages.shown_at(e) if e else None)
            for role, path, e in inputs_of(entry, entries, library.root)
        ],
        made=[(e, pages.shown_at(e)) for e in outputs_of(entry, entries, library.root)],
        others=comparable_files(entry, entries),
    )


def maps_of(opened: Product) -> list[dict[str, Any]]:
    """Maps of a product, its main one first: each dataset without its errors, one entry for each number of a vector."""
    maps = []
    first = FIRST.get(opened.kind, opened.kind)
    if is_stokes_vector(opened) and "stokes" not in opened.names:
        # The first column of M, which is the Stokes vector.
        column = {"name": "mueller", "about": opened.long_name("mueller"), "units": "count", "errors": True}
        maps = [column | {"index": 4 * k, "label": f"S{k}"} for k in range(4)]
    if "stokes" in opened.names:
        first = "stokes"
    for name in sorted(opened.names, key=lambda name: name != first):
        if name.endswith(COMPANIONS) or name in ("mueller", "mueller_covariance"):
            continue
        count = opened.get(name, slice(0, 1)).size // opened.shape[1]
        common: dict[str, Any] = {"name": name, "about": opened.long_name(name), "units": opened.units(name)}
        common["errors"] = f"{name}_errors" in opened.names
        if count <= 16:
            words = name.replace("_", " ")
            maps += [common | {"index": k, "label": words if count == 1 else f"{words} {k}"} for k in range(count)]
    return maps


def choices_of(product: Product) -> list[dict[str, Any]]:
    """Choices of a product: elements over m00, its maps, quantities of a whole M."""
    choices = maps_of(product)
    if is_stokes_vector(product):
        elements = [{"label": f"S{k} over S0", "name": "mueller", "index": 4 * k} for k in range(1, 4)]
        choices = [
            *elements,
            {"label": "S0", "name": "mueller", "index": 0},
            *(m for m in choices if m["name"] != "mueller"),
        ]
    elif product.kind in MATRICES:
        elements = [{"label": f"m{k // 4}{k % 4} over m00", "name": "mueller", "index": k} for k in range(1, 16)]
        choices = [*elements, {"label": "m00", "name": "mueller", "index": 0}, *choices]
    if is_whole(product):
        choices += [{"label": name.replace("_", " "), "name": name, "index": 0} for name in DERIVED]
    return choices


def is_whole(product: Product) -> bool:
    """Whether a product determines every element of M."""
    return product.kind == "mueller" and int(product.facts.get("rank", 16)) == 16


def plane(request: Request) -> Response:
    """Part of one map of a product, or of its standard errors (`errors`); where it is not valid it has no value."""
    path, query = file_of(request), request.query_params
    with Product(path) as opened:
        name, index = named(opened, query)
        window = Window.parse(query, opened.shape)
        values = read_map(opened, name, index, window)
        scale = scale_of(name, opened.units(name), values)
        return plane_response(window, values[None], **legend(scale, opened.units(name)))


def read_map(opened: Product, name: str, index: int, window: Window) -> NDArray[np.float32]:
    """One map of a product in a window; NaN where no valid mask of the product holds, or no angle is determined."""
    values = _element(opened, name, index, window).astype(np.float32)
    if name not in ("lit", "valid", "pixel_flags"):
        for mask in ("lit", "valid"):
            if mask in opened.names:
                values[window.every(opened.get(mask, window.rows)) == 0] = np.nan
    if f"{name}_errors" in opened.names and period_deg(name, opened.units(name)) is not None:
        # An angle without an error bar is that of noise, and would show in every colour.
        errors = _element(opened, f"{name}_errors", index, window)
        if np.isfinite(errors).any():
            values[np.isnan(errors)] = np.nan
    return np.asarray(values)


def _element(opened: Product, name: str, index: int, window: Window) -> NDArray[Any]:
    planes = opened.get(name, window.rows)
    return np.asarray(window.every(planes.reshape(-1, *planes.shape[-2:])[index]))


def named(opened: Product, query: Any) -> tuple[str, int]:
    """Dataset and element of it that a request asks for. Raises ProcessError."""
    name = str(query.get("name", ""))
    if query.get("errors") and f"{name}_errors" in opened.names:
        name = f"{name}_errors"
    try:
        index = int(query.get("index", 0))
        if not 0 <= index < opened.get(name, slice(0, 1)).size // opened.shape[1]:
            raise ValueError("there is no such element")
    except ValueError as error:
        raise ProcessError(f"{name}: {error}") from error
    return name, index


def legend(scale: ColourScale, units: str) -> dict[str, Any]:
    """A scale and a unit, for the page."""
    return {"colours": scale.colours, "low": scale.low, "high": scale.high, "units": units_words(units)}


def mueller(request: Request) -> Response:
    """Sixteen pictures, the elements over m00 or in counts, on one scale; `errors`: their standard errors."""
    path, query = file_of(request), request.query_params
    with Product(path) as opened:
        opened.require(*MATRICES)
        window = Window.parse(query, opened.shape, most=320)
        elements, scale = read_mueller(opened, window, bool(query.get("normalized")), bool(query.get("errors")))
        light = scale_of("m00", "count", elements[0])
    facts = legend(scale, "" if query.get("normalized") else "counts") | {"light": light.high, "light_colours": LIGHT}
    return plane_response(window, elements, **facts)


def read_mueller(
    opened: Product, window: Window, normalized: bool, errors: bool
) -> tuple[NDArray[np.float32], ColourScale]:
    """Elements (16, rows, columns) in a window and the scale of all but the first; NaN where it is too dark.

    The error of an element over m00 is its own over m00: that of m00 is left out, which is far smaller.
    """
    elements = window.every(opened.get("mueller", window.rows)).reshape(16, *window.shape).astype(np.float32)
    stderr = window.every(opened.get("mueller_errors", window.rows)).reshape(16, *window.shape)
    m00 = elements[0].copy()
    with np.errstate(invalid="ignore", divide="ignore"):
        lit = is_lit(m00, stderr[0])
        image = np.asarray(stderr if errors else elements, dtype=np.float32)
        if normalized:
            image = image / m00
            image[0] = stderr[0] / m00 if errors else m00
    image[1:, ~lit] = np.nan
    name = "mueller_errors" if errors else "mueller"
    scale = scale_of(name, "", image[1:])
    if scale.colours == SIGNED and normalized:
        scale = ColourScale(SIGNED, max(scale.low, -1.0), min(scale.high, 1.0))
    return image, scale


def units_words(units: str) -> str:
    """A unit for the side of a colour bar."""
    return {"degree": "degrees", "count": "counts", "count2": "counts squared"}.get(units, units)
