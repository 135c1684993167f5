"""A report as one HTML file: text, tables and figures inside, nothing fetched from anywhere."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass

from processing.reports.design import style, templates


@dataclass(frozen=True)
class Figure:
    """A picture: PNG or SVG bytes and what it shows."""

    data: bytes
    caption: str
    media_type: str = "image/png"

    @property
    def address(self) -> str:
        """The picture itself, as an address."""
        return f"data:{self.media_type};base64,{base64.b64encode(self.data).decode('ascii')}"


@dataclass(frozen=True)
class ReportSection:
    """One file of the report."""

    title: str
    summary: Sequence[tuple[str, str]]
    figures: Sequence[Figure] = ()
    tables: Sequence[tuple[str, Sequence[Sequence[str]]]] = ()
    warnings: Sequence[str] = ()
    notes: Sequence[tuple[str, str]] = ()


def render(title: str, simulated: bool, footer: str, sections: Sequence[ReportSection]) -> str:
    """HTML text of a report; every text is escaped by the template."""
    warned = [(number, section, text) for number, section in enumerate(sections) for text in section.warnings]
    return (
        templates()
        .get_template("report.html")
        .render(title=title, simulated=simulated, made=footer, sections=sections, warned=warned, style=style())
    )
