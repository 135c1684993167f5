"""A run as it goes on: a stream of events for the page, and the stop button."""

import os
import signal
from pathlib import Path
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, StreamingResponse

from acquisition.capture.partial_file import PARTIAL
from acquisition.screen.run_file import running_in
from processing.errors import ProcessError
from processing.storage.captures.capture import Capture
from viewer.campaigns import read_campaign, seconds_left
from viewer.event_stream import event_stream
from viewer.lamp import lamp
from viewer.library import Library
from viewer.pages import fields_of, file_of, pages_of


async def events(request: Request) -> StreamingResponse:
    """Server-sent events: the state of the run in a folder, whenever it has changed."""
    folder, library = file_of(request, "folder"), pages_of(request).library

    def look() -> dict[str, Any]:
        try:
            return run_state(folder, library)
        except ProcessError as error:
            return {"running": False, "error": str(error)}

    return event_stream(request, look)


def run_state(folder: Path, library: Library) -> dict[str, Any]:
    """The state of a running campaign for a page, also that none runs."""
    run = running_in(folder)
    view = read_campaign(folder, library, None if run is None else run.get("capture"))
    state: dict[str, Any] = {"running": run is not None}
    if view is not None:
        state |= {"complete": view.complete, "cells": {cell.name: cell.status for cell in view.cells}}
        state["logged"] = view.events[:1]
        if run is not None:
            state["night_s"] = seconds_left(view, run)
    if run is None:
        return state
    state |= {key: run.get(key) for key in ("title", "activity", "done", "pending", "left_s", "messages", "capture")}
    state |= {"number": run.get("campaign_done", 0) + 1, "total": run.get("campaign_total", 1)}
    state["axes"] = run.get("axes") or {}
    state |= _current_capture(folder / str(run.get("capture")), library)
    return state


def _current_capture(final: Path, library: Library) -> dict[str, Any]:
    """The capture that is being taken, or was just sealed: its file, states done, and the lamp."""
    for path in (final.with_name(final.name + PARTIAL), final):
        if library.holds(path):
            with Capture(path) as capture:
                return {"file": library.name(path), "states": len(capture.done), "lamp": lamp(capture)}
    return {}


async def stop(request: Request) -> JSONResponse:
    """Send the process of the run what Ctrl-C sends. Raises ProcessError where none runs."""
    fields = await fields_of(request)
    folder = pages_of(request).library.path(fields.get("folder", ""))
    run = running_in(folder)
    if run is None:
        raise ProcessError("no run is active in this folder")
    os.kill(int(run["pid"]), signal.SIGINT)
    return JSONResponse({"stopping": True})
