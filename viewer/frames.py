"""A capture: its frames as pictures, their histograms, and the table of its states."""

from typing import Any

import numpy as np
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response

from processing.computing.png import png
from processing.errors import ProcessError
from processing.reduction.counts_to_signal import saturation
from processing.reports.capture_facts import facts_of, papers_of
from processing.storage.captures.capture import Capture
from viewer.diagnoses import Diagnoses
from viewer.library import Entry, outputs_of
from viewer.notes import Note, notes_of
from viewer.pages import file_of, pages_of
from viewer.planes import Window, plane_response
from viewer.starting import geometry_files, instrument_files, material_files

#: Most bars of a histogram.
BARS = 256
#: Longest side of a preview, pixels.
PREVIEW = 480
RED = (227, 18, 45)


def capture(request: Request) -> HTMLResponse:
    """The page of a capture."""
    pages, path = pages_of(request), file_of(request)
    library = pages.library
    entry = library.entry(library.name(path))
    with Capture(path) as record:
        facts = [
            *facts_of(record),
            ("begun", record.start_time),
            ("checksums", "every state is verified against them" if record.checked else "none in the file"),
        ]
        if segments := len(record.segments) - 1:
            facts.append(("interrupted", f"{segments} time(s) and resumed"))
        notes = papers_of(record.header)
        states = states_of(record)
        warnings = [str(message) for message in record.closing.get("messages", [])]
    entries = library.entries()
    return pages.draw(
        "capture.html",
        simulated=entry.simulated,
        entry=entry,
        note=notes_of(library).get(entry.name, Note()),
        facts=facts,
        notes=notes,
        warnings=warnings,
        states=states,
        first=next((k for k, role in enumerate(states["role"]) if role != "dark"), 0),
        made=[(e, pages.shown_at(e)) for e in outputs_of(entry, entries, library.root)],
        others=comparable_files(entry, entries),
        writing=entry.status == "running",
        instruments=list(instrument_files(library)),
        materials=list(material_files(library)),
        geometries=list(geometry_files(library)),
        stories=Diagnoses(library).of_capture(entry.name),
    )


def comparable_files(entry: Entry, entries: list[Entry]) -> list[Entry]:
    """Files of the same kind and mode, to compare with."""
    mode = None if entry.header is None else entry.header.mode
    same_kind = [e for e in entries if e.kind == entry.kind and e is not entry]
    return [e for e in same_kind if e.header is not None and e.header.mode == mode]


def states_of(opened: Capture) -> dict[str, Any]:
    """The states done, for a page: roles, angles, exposures, limits of the scale."""
    detector = opened.header.detector
    top = saturation(opened)
    return {
        "number": [int(k) for k in opened.done],
        "role": list(opened.role),
        "angles_deg": {name: _plain(values) for name, values in opened.angles_deg.items()},
        "voltages": list(opened.header.voltages),
        "exposure_s": _plain(opened.column("exposure_s")),
        "saturated_fraction": _plain(opened.column("saturated_fraction")),
        "channels": list(opened.header.channels),
        "shape": list(opened.frame_shape),
        "black": detector.black_level_counts,
        "saturation": top,
    }


def _plain(values: Any) -> list[float | None]:
    return [round(float(v), 6) if np.isfinite(v) else None for v in values]


def states(request: Request) -> JSONResponse:
    """The states done by now, for a capture that is being written."""
    with Capture(file_of(request)) as record:
        return JSONResponse(states_of(record) | {"status": record.status, "planned": record.planned_states})


def frame(request: Request) -> Response:
    """Part of a frame: two pictures, mean counts and where a pixel is saturated (1, else 0)."""
    path, query = file_of(request), request.query_params
    with Capture(path) as record:
        state, channel = chosen_frame(record, query)
        window = Window.parse(query, record.frame_shape)
        counts = record.frames(state, window.rows)[channel]
        top = saturation(record)
    mean = window.mean(counts)
    red = np.zeros_like(mean) if top is None else window.largest(counts) >= top
    return plane_response(window, np.stack([mean, red.astype(np.float32)]), state=state)


def preview(request: Request) -> Response:
    """A frame as a small picture (PNG), shown until the page's script has drawn the one that can be zoomed."""
    path, query = file_of(request), request.query_params
    with Capture(path) as record:
        state, channel = chosen_frame(record, query)
        window = Window.parse({key: query[key] for key in ("most",) if key in query}, record.frame_shape, most=PREVIEW)
        counts = record.frames(state)[channel]
        top, black = saturation(record), record.header.detector.black_level_counts
    mean = window.mean(counts)
    high = float(np.nanmax(mean))
    grey = np.nan_to_num(np.clip((mean - black) / max(high - black, 1.0), 0, 1)) * 255
    picture = np.repeat(grey.astype(np.uint8)[..., np.newaxis], 3, axis=2)
    if top is not None:
        picture[window.largest(counts) >= top] = RED
    return Response(png(picture), media_type="image/png")


def chosen_frame(opened: Capture, query: Any) -> tuple[int, int]:
    """State (among those done; -1 is the last) and channel that a request asks for. Raises ProcessError."""
    done = len(opened.done)
    try:
        state, channel = int(query.get("state", 0)), int(query.get("channel", 0))
    except ValueError as error:
        raise ProcessError(f"state and channel must be whole numbers ({error})") from error
    state += done if state < 0 else 0
    if not 0 <= state < done or not 0 <= channel < opened.channels:
        raise ProcessError(f"{opened.path.name} has {done} states done; channels: {opened.channels}")
    return state, channel


def histogram(request: Request) -> JSONResponse:
    """Pixels of a frame by their counts: edges of the bars, pixels in each, and where the range ends."""
    path, query = file_of(request), request.query_params
    with Capture(path) as record:
        state, channel = chosen_frame(record, query)
        counts = record.frames(state)[channel]
        top, black = saturation(record), record.header.detector.black_level_counts
    finite = counts[np.isfinite(counts)] if counts.dtype.kind == "f" else counts
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    if counts.dtype.kind in "ui":
        # Whole counts: bars of a whole number of counts each, or some would hold one value more than their neighbours.
        wide = max(1, -(-int(high - low + 1) // BARS))
        edges = np.arange(int(low), int(high) + wide + 1, wide, dtype=float) - 0.5
    else:
        edges = np.linspace(low, high if high > low else low + 1, BARS + 1)
    pixels, _ = np.histogram(finite, edges)
    saturated = 0 if top is None else int(np.count_nonzero(counts >= top))
    return JSONResponse(
        {
            "edges": edges.tolist(),
            "pixels": pixels.tolist(),
            "black": black,
            "saturation": top,
            "saturated": saturated,
            "of": int(counts.size),
        }
    )
