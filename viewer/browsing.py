"""The first page, and the page of a campaign."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from starlette.requests import Request
from starlette.responses import HTMLResponse

from acquisition.screen.run_file import running_in
from viewer.campaigns import STATUS, CampaignView, read_campaign
from viewer.jobs import Jobs
from viewer.library import Entry, Library, NotHere, made_from
from viewer.pages import file_of, pages_of
from viewer.starting import campaign_files, resumed_with

#: Files on one page of a list; more are found by searching.
MOST = 300


def browse(request: Request) -> HTMLResponse:
    """Campaigns, captures and products of the folder; `q` searches."""
    pages, query = pages_of(request), request.query_params.get("q", "")
    library = pages.library
    jobs = Jobs(library.root)
    entries = library.entries()
    words = query.lower().split()
    found = [e for e in entries if all(word in e.words for word in words)]
    views = [view for f in library.campaigns() if (view := read_campaign(f, library)) is not None]
    campaigns = [(v, running_in(library.root / v.name)) for v in views if all(w in v.name.lower() for w in words)]
    return pages.draw(
        "browse.html",
        simulated=_all_simulated(found),
        query=query,
        campaigns=campaigns,
        statuses=STATUS,
        captures=[e for e in found if e.kind in ("capture", "unreadable")][:MOST],
        products=[(e, made_from(e, entries, library.root)) for e in found if e.kind not in ("capture", "unreadable")][
            :MOST
        ],
        found=len(found),
        total=len(entries),
        shown_at=pages.shown_at,
        files=list(campaign_files(library)),
        jobs=[(job, jobs.status(job)) for job in jobs.all()[:8]],
    )


def _all_simulated(entries: list[Entry]) -> bool:
    readable = [e for e in entries if e.kind != "unreadable"]
    return bool(readable) and all(e.simulated for e in readable)


def campaign(request: Request) -> HTMLResponse:
    """One campaign: grid, timeline, log, and what its run does now."""
    pages = pages_of(request)
    view = _campaign(pages.library, file_of(request, "folder"))
    return pages.draw(
        "campaign.html",
        simulated=view.simulated,
        view=view,
        statuses=STATUS,
        bars=[asdict(bar) for bar in view.bars],
        resumes=resumed_with(pages.library.root / view.name),
    )


def _campaign(library: Library, folder: Path) -> CampaignView:
    run = running_in(folder)
    view = read_campaign(folder, library, None if run is None else run.get("capture"))
    if view is None:
        raise NotHere(f"{library.name(folder)}: no campaign was begun in this folder")
    return view
