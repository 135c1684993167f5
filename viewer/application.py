"""The application: which address is answered by what."""

from pathlib import Path

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from processing.errors import ProcessError
from viewer import (
    alarms,
    browsing,
    comparing,
    following,
    frames,
    notes,
    probes,
    products,
    regions,
    stacks,
    starting,
    verdicts,
)
from viewer.guard import PageGuard
from viewer.library import Library, NotHere
from viewer.pages import Pages, pages_of, whole_style

STATIC = Path(__file__).parent / "static"
#: The plotting library; its address has its version, so that a browser may keep it.
PLOTLY = STATIC / "plotly" / "plotly-cartesian-4.1.1.min.js"


def application(folder: Path, token: str) -> Starlette:
    """The application for one folder; every address begins with the token.

    Starlette runs endpoints that are plain functions in threads: a large read does not block other requests.
    """
    routes = [
        Route("/", browsing.browse),
        Route("/campaign", browsing.campaign),
        Route("/events", following.events),
        Route("/stop", following.stop, methods=["POST"]),
        Route("/alarms", alarms.alarms_now),
        Route("/acknowledge", alarms.acknowledge, methods=["POST"]),
        Route("/capture", frames.capture),
        Route("/states", frames.states),
        Route("/frame", frames.frame),
        Route("/preview", frames.preview),
        Route("/histogram", frames.histogram),
        Route("/product", products.product),
        Route("/plane", products.plane),
        Route("/mueller", products.mueller),
        Route("/probe", probes.of_product),
        Route("/regions", regions.regions),
        Route("/regions.csv", regions.table),
        Route("/keep-region", regions.keep_region, methods=["POST"]),
        Route("/drop-region", regions.drop_region, methods=["POST"]),
        Route("/stack", stacks.stack),
        Route("/stacked", stacks.stacked),
        Route("/stack.csv", stacks.table),
        Route("/note", notes.write_note, methods=["POST"]),
        Route("/compare", comparing.compare),
        Route("/difference", comparing.difference),
        Route("/start", starting.start, methods=["POST"]),
        Route("/job", starting.job),
        Route("/job-events", starting.job_events),
        Route("/stop-job", starting.stop_job, methods=["POST"]),
        Route("/diagnosis", verdicts.diagnosis),
        Route("/diagnosis-report", verdicts.report),
        Route("/residual-map", verdicts.residual_map),
        Route("/residual-curve", verdicts.residual_curve),
        Route("/decide", verdicts.decide, methods=["POST"]),
        Route("/curve", probes.curve_of),
        Route("/matrix", probes.matrix_of),
        Route("/style.css", _style),
        Route(f"/{PLOTLY.name}", _plotly),
        Mount("/static", StaticFiles(directory=STATIC)),
    ]
    app = Starlette(
        routes=[Mount(f"/{token}", routes=routes)],
        middleware=[Middleware(PageGuard, token=token)],
        exception_handlers={ProcessError: _refusal_page},
    )
    app.state.pages = Pages(Library(folder), f"/{token}", f"/{token}/{PLOTLY.name}")
    return app


async def _style(request: Request) -> Response:
    return Response(whole_style(), media_type="text/css")


async def _plotly(request: Request) -> Response:
    return FileResponse(PLOTLY, headers={"Cache-Control": "private, max-age=31536000, immutable"})


async def _refusal_page(request: Request, error: Exception) -> Response:
    code = 404 if isinstance(error, NotHere) else 422
    if "text/html" in request.headers.get("accept", ""):
        return pages_of(request).draw("refused.html", code=code, text=str(error))
    return Response(str(error), code, media_type="text/plain")
