"""Shared by all pages: the templates, the library, and the page of a file of the folder."""

import os
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from starlette.requests import Request
from starlette.responses import HTMLResponse

from acquisition.rig.alarms import unacknowledged
from processing.doors import parse_json
from processing.errors import ProcessError
from processing.reports.design import style
from viewer.library import Entry, Library

#: Most bytes that a page sends: the names of its files.
MOST_SENT = 1 << 20


class Pages:
    """Draws pages of one folder.

    Parameters
    ----------
    root : first part of every address, with the token.
    plotly : address of the plotting library.
    """

    def __init__(self, library: Library, root: str, plotly: str) -> None:
        self.library, self.root = library, root
        self._templates = Environment(
            loader=ChoiceLoader([PackageLoader("viewer"), PackageLoader("processing.reports", "design")]),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        self._templates.globals |= {
            "root": root,
            "plotly": plotly,
            "folder": library.root,
            "address": self.address,
            "unacknowledged": unacknowledged,
            "ago": ago,
            # As the user started this program, in commands that a page suggests.
            "door": os.environ.get("UMOV_DOOR", "./lab"),
        }
        self._templates.filters |= {"megabytes": megabytes, "when": when}

    def draw(self, template: str, *, simulated: bool = False, code: int = 200, **values: Any) -> HTMLResponse:
        """A page; `simulated` puts the banner on it."""
        text = self._templates.get_template(template).render(simulated=simulated, **values)
        # Bytes of file names that are not UTF-8 become question marks.
        return HTMLResponse(text.encode(errors="replace"), code)

    def address(self, what: str, **query: object) -> str:
        """Address of a page or a picture, with its query."""
        parameters = urlencode({key: v for key, v in query.items() if v is not None}, errors="surrogateescape")
        return f"{self.root}/{what}" + (f"?{parameters}" if parameters else "")

    def shown_at(self, entry: Entry) -> str | None:
        """Address of the page that shows a file; None for one that has no page."""
        if entry.kind in ("unreadable", "table"):
            return None
        return self.address("capture" if entry.kind == "capture" else "product", file=entry.name)


def pages_of(request: Request) -> Pages:
    """The pages of the application that answers a request."""
    pages: Pages = request.app.state.pages
    return pages


def file_of(request: Request, name: str = "file") -> Path:
    """The file that a request names. Raises NotHere."""
    return pages_of(request).library.path(request.query_params.get(name, ""))


async def fields_of(request: Request) -> dict[str, str]:
    """The texts that a page sends, as JSON. Raises ProcessError."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MOST_SENT:
            raise ProcessError(f"a page sends at most {MOST_SENT:,} bytes")
    fields = parse_json(body, "what the page sent")
    if not isinstance(fields, dict) or not all(isinstance(value, str) for value in fields.values()):
        raise ProcessError("a page sends named texts")
    return fields


def whole_style() -> str:
    """The style sheet of the application: the one of the reports, and what only an application has."""
    return style() + (Path(__file__).parent / "static" / "app.css").read_text(encoding="utf-8")


def megabytes(size: int) -> str:
    """Size of a file in words."""
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.0f} kB"


def when(seconds: float) -> str:
    """Local date and time of a time stamp."""
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))


def ago(seconds: float) -> str:
    """How long ago a time stamp was, roughly."""
    past = max(time.time() - seconds, 0)
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if past >= length:
            return f"{past / length:.0f} {unit} ago"
    return "just now"
