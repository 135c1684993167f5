"""The one look of umov's pages: a style sheet and templates, for reports as one file and for the application."""

from functools import cache
from importlib.resources import files

from jinja2 import Environment, PackageLoader, StrictUndefined


@cache
def style() -> str:
    """The style sheet, CSS text."""
    return files("processing.reports.design").joinpath("umov.css").read_text(encoding="utf-8")


@cache
def templates() -> Environment:
    """Templates of the reports; every text is escaped."""
    return Environment(
        loader=PackageLoader("processing.reports", "design"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
