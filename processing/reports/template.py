"""A report as one HTML file: text, tables and figures inside, nothing fetched from anywhere."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; color: #222; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.5rem; border-bottom: 1px solid #ccc; }
h3 { font-size: 1rem; margin-bottom: .3rem; }
table { border-collapse: collapse; margin: .5rem 0; } td, th { padding: .15rem .8rem .15rem 0; text-align: left;
  vertical-align: top; font-variant-numeric: tabular-nums; } th { font-weight: 600; }
.scroll { overflow-x: auto; }
img { max-width: 100%; } .simulated { background: #7a0000; color: #fff; padding: .5rem 1rem; font-weight: 600; }
.warning { background: #fff3cd; border-left: 4px solid #d39e00; padding: .4rem .8rem; margin: .3rem 0; }
nav a { display: block; } details { margin: .3rem 0; } pre { white-space: pre-wrap; font-size: 13px; }
"""


@dataclass(frozen=True)
class Figure:
    """A picture: PNG or SVG bytes and what it shows."""

    data: bytes
    caption: str
    media_type: str = "image/png"


@dataclass(frozen=True)
class Section:
    """One file of the report."""

    title: str
    summary: Sequence[tuple[str, str]]
    figures: Sequence[Figure] = ()
    tables: Sequence[tuple[str, Sequence[Sequence[str]]]] = ()
    warnings: Sequence[str] = ()
    notes: Sequence[tuple[str, str]] = ()


def render(title: str, simulated: bool, made: str, sections: Sequence[Section]) -> str:
    """HTML text of a report; every text is escaped here."""
    parts = [
        "<!DOCTYPE html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f"<title>{escape(title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1>",
    ]
    if simulated:
        parts.append('<p class="simulated">SIMULATED: no part of these data was measured.</p>')
    parts.append(f"<p>{escape(made)}</p>")
    warned = [(k, w) for k, s in enumerate(sections) for w in s.warnings]
    if warned:
        parts.append(f"<h2>Warnings ({len(warned)})</h2>")
        parts += [
            f'<p class="warning"><a href="#s{k}">{escape(sections[k].title)}</a>: {escape(w)}</p>' for k, w in warned
        ]
    links = " ".join(f'<a href="#s{k}">{escape(s.title)}</a>' for k, s in enumerate(sections))
    parts.append(f"<nav>{links}</nav>")
    for k, section in enumerate(sections):
        parts += _section(k, section)
    parts.append("</body></html>")
    return "\n".join(parts)


def _section(number: int, section: Section) -> list[str]:
    parts = [f'<h2 id="s{number}">{escape(section.title)}</h2>']
    parts += [f'<p class="warning">{escape(w)}</p>' for w in section.warnings]
    parts.append(_table([("", "")], section.summary) if section.summary else "")
    for figure in section.figures:
        data = base64.b64encode(figure.data).decode("ascii")
        caption = escape(figure.caption)
        parts.append(f'<figure><img alt="{caption}" src="data:{figure.media_type};base64,{data}">')
        parts.append(f"<figcaption>{caption}</figcaption></figure>")
    for name, rows in section.tables:
        parts.append(f"<h3>{escape(name)}</h3>")
        parts.append(_table(rows[:1], rows[1:]))
    for name, text in section.notes:
        parts.append(f"<details><summary>{escape(name)}</summary><pre>{escape(text)}</pre></details>")
    return [p for p in parts if p]


def _table(head: Sequence[Sequence[str]], rows: Sequence[Sequence[str]]) -> str:
    lines = ['<div class="scroll"><table>']
    for row in head:
        if any(row):
            lines.append("<tr>" + "".join(f"<th>{escape(c)}</th>" for c in row) + "</tr>")
    lines += ["<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows]
    return "".join([*lines, "</table></div>"])
