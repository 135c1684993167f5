"""The page of a diagnosis: its verdict as a story, with linked maps and state plots, and the decision."""

from pathlib import Path
from typing import Any

import numpy as np
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, Response

from processing.diagnosis.instrument.residual_file import MOMENTS, StoredResidual
from processing.doors import require_file
from processing.errors import ProcessError
from processing.reports.colours import ALL, PLAIN, SIGNED, steps
from viewer.diagnoses import Diagnoses
from viewer.library import NotHere
from viewer.pages import fields_of, pages_of
from viewer.planes import Window, plane_response
from viewer.probing import Region, finite


def diagnoses_of(request: Request) -> Diagnoses:
    """The diagnoses of the folder of the application."""
    return Diagnoses(pages_of(request).library)


def diagnosis(request: Request) -> HTMLResponse:
    """The page of a diagnosis."""
    pages, diagnoses = pages_of(request), diagnoses_of(request)
    name = request.query_params.get("name", "")
    story = diagnoses.story(name)
    residuals = diagnoses.residuals(name)
    result = story.diagnosis
    return pages.draw(
        "diagnosis.html",
        simulated=result.simulated,
        story=story,
        found=result,
        proposed=_free_name(pages.library.root, story.model),
        captures=[(capture, pages.address("capture", file=capture)) for capture in story.captures],
        look={"captures": [_residual_entry(residual) for residual in residuals]},
        colours={name: steps(name) for name in ALL},
    )


def _free_name(folder: Path, model: str) -> str:
    stem = "".join(c if c.isalnum() else "_" for c in model).strip("_") or "model"
    number = 2
    while (folder / f"{stem}_{number}.yaml").exists():
        number += 1
    return f"{stem}_{number}.yaml"


def _residual_entry(residual: StoredResidual) -> dict[str, Any]:
    rows, columns = residual.images["before"].shape[-2:]
    rms_images = [_rms(residual, moment) for moment in MOMENTS]
    valid = np.concatenate([image[np.isfinite(image)] for image in rms_images])
    return {
        "name": residual.name,
        "shape": [rows, columns],
        "per_state": {moment: finite(values) for moment, values in residual.per_state.items()},
        "harmonics": residual.harmonics,
        # Before and after on one scale, or they could not be compared.
        "loudest": float(np.percentile(valid, 99.5)) if valid.size else 1.0,
    }


def _rms(residual: StoredResidual, moment: str) -> Any:
    return np.sqrt(np.mean(np.square(residual.images[moment].astype(np.float32)), axis=0))


def residual_map(request: Request) -> Response:
    """Two pictures, before and after: the rms over the states, or one of them (`state`)."""
    residual = _chosen(request)
    query = request.query_params
    window = Window.parse(query, residual.images["before"].shape[-2:])
    state = query.get("state")
    try:
        images = [
            _rms(residual, m) if state is None else residual.images[m][int(state)].astype(np.float32) for m in MOMENTS
        ]
    except (ValueError, IndexError) as error:
        raise ProcessError(f"there is no state {state} in this diagnosis") from error
    colours = PLAIN if state is None else SIGNED
    pictures = np.stack([window.every(image[window.rows]) for image in images])
    return plane_response(window, pictures, colours=colours, units="noise of one intensity")


def residual_curve(request: Request) -> JSONResponse:
    """Residual of each state, before and after, mean over a pixel or a region in units of the noise of that mean."""
    residual = _chosen(request)
    region = Region.parse(request.query_params, residual.images["before"].shape[-2:])
    curves: dict[str, Any] = {"where": str(region)}
    for moment in MOMENTS:
        part = residual.images[moment][:, region.rows, region.columns].astype(float).reshape(-1, region.pixels)
        with np.errstate(invalid="ignore"):
            used = np.isfinite(part).sum(axis=1)
            curves[moment] = finite(np.nansum(part, axis=1) / np.sqrt(np.where(used > 0, used, np.nan)))
    return JSONResponse(curves)


def _chosen(request: Request) -> StoredResidual:
    residuals = diagnoses_of(request).residuals(request.query_params.get("name", ""))
    try:
        return residuals[int(request.query_params.get("capture", 0))]
    except (ValueError, IndexError) as error:
        raise ProcessError("this diagnosis has no residuals of such a capture") from error


async def decide(request: Request) -> JSONResponse:
    """Accept the corrected model, which writes new files, or reject it; both with a note."""
    fields, diagnoses = await fields_of(request), diagnoses_of(request)
    name, note = fields.get("name", ""), fields.get("note", "")
    if fields.get("accept"):
        files = await run_in_threadpool(diagnoses.accept, name, fields.get("file", ""), note)
        return JSONResponse({"files": [path.name for path in files]})
    diagnoses.reject(name, note)
    return JSONResponse({"files": []})


def report(request: Request) -> Response:
    """The report of the diagnosis as `diagnose --report` writes it."""
    path = diagnoses_of(request).folder(request.query_params.get("name", "")) / "report.html"
    require_file(path, NotHere)
    return FileResponse(path, media_type="text/html")
