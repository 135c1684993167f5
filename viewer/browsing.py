"""The first page, and the page of a campaign."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import HTMLResponse

from acquisition.screen.run_file import running_in
from processing.commands.batch import natural
from viewer.campaigns import STATUS, CampaignView, read_campaign
from viewer.jobs import Jobs
from viewer.library import Entry, Library, NotHere, inputs_of
from viewer.notes import Note, notes_of
from viewer.pages import file_of, pages_of
from viewer.starting import campaign_files, resume_preview

#: Files on one page of a list.
MOST = 50
#: Keys of sorting, with the names of the columns; a minus turns the order round.
SORTS: dict[str, Callable[[Entry], Any]] = {
    "name": lambda e: natural(Path(e.name)),
    "sample": lambda e: e.sample,
    "nm": lambda e: 0.0 if e.header is None else e.header.wavelength_nm,
    "omega": lambda e: -1.0 if e.header is None or e.header.omega_deg is None else e.header.omega_deg,
    "mode": lambda e: "" if e.header is None else e.header.mode,
    "states": lambda e: e.states or (0, 0),
    "status": lambda e: e.status,
    "kind": lambda e: e.kind,
    "size": lambda e: e.size,
    "changed": lambda e: e.changed_s,
}


@dataclass(frozen=True)
class Listed:
    """One page of a list: its files, the address of any other page, and of the list in another order.

    Attributes
    ----------
    groups : of each file its group, and how many files the list has of it; none where it is not grouped.
    """

    entries: list[Entry]
    page: int
    pages: int
    total: int
    key: str
    sort: str
    query: dict[str, str]
    root: str
    group: str = ""
    groups: tuple[tuple[str, int], ...] = ()

    @classmethod
    def of(
        cls,
        entries: list[Entry],
        key: str,
        request: Request,
        groups: Mapping[str, Callable[[Entry], str]] = MappingProxyType({}),
    ) -> "Listed":
        """The page that a request asks for with `<key>_page`, `<key>_sort` and `<key>_group`; newest files first.

        Parameters
        ----------
        groups : keys of grouping, each with the function that gives the group of a file; empty where it is in none.
        """
        query = dict(request.query_params)
        sort, group = query.get(f"{key}_sort", ""), query.get(f"{key}_group", "")
        if sort.removeprefix("-") in SORTS:
            entries = sorted(entries, key=SORTS[sort.removeprefix("-")], reverse=sort.startswith("-"))
        counts: Counter[str] = Counter()
        if group in groups:
            # The sort is stable: inside a group the order stays.
            entries = sorted(entries, key=lambda e: ((name := groups[group](e)) == "", natural(Path(name))))
            counts.update(map(groups[group], entries))
        pages = max(1, -(-len(entries) // MOST))
        number = query.get(f"{key}_page", "1")
        page = min(max(int(number) if number.isdecimal() else 1, 1), pages)
        page_entries = entries[(page - 1) * MOST : page * MOST]
        of_shown = tuple((name, counts[name]) for e in page_entries if counts for name in [groups[group](e)])
        root = pages_of(request).root
        return cls(page_entries, page, pages, len(entries), key, sort, query, root, group if counts else "", of_shown)

    def at(self, page: int) -> str:
        """Address of a page of the list."""
        return self._address({f"{self.key}_page": str(page)})

    def by(self, column: str) -> str:
        """Address of the list sorted by a column; once more turns the order round."""
        order = f"-{column}" if self.sort == column else column
        return self._address({f"{self.key}_sort": order, f"{self.key}_page": "1"})

    def grouped(self, by: str) -> str:
        """Address of the list grouped by a campaign or a sample, or not grouped."""
        return self._address({f"{self.key}_group": by, f"{self.key}_page": "1"})

    def arrow(self, column: str) -> str:
        """A sign at the column that the list is sorted by."""
        return {column: " ▲", f"-{column}": " ▼"}.get(self.sort, "")

    def _address(self, more: dict[str, str]) -> str:
        return f"{self.root}/?{urlencode(self.query | more, errors='replace')}#{self.key}"


def _campaign_of(campaigns: Sequence[str], entry: Entry) -> str:
    """The campaign whose folder a file lies in, the innermost one; empty where there is none."""
    inside = [name for name in campaigns if entry.name.startswith(f"{name}/")]
    return max(inside, key=len, default="")


def browse(request: Request) -> HTMLResponse:
    """Campaigns, captures and products of the folder; `q` searches."""
    pages, query = pages_of(request), request.query_params.get("q", "")
    library = pages.library
    jobs = Jobs(library.root)
    entries = library.entries()
    words = query.lower().split()
    notes = notes_of(library)
    none = Note()
    matches = [e for e in entries if all(w in e.words or w in notes.get(e.name, none).words for w in words)]
    views = [view for f in library.campaigns() if (view := read_campaign(f, library)) is not None]
    campaigns = [(v, running_in(library.root / v.name)) for v in views if all(w in v.name.lower() for w in words)]
    products = Listed.of([e for e in matches if e.kind not in ("capture", "unreadable")], "products", request)
    return pages.draw(
        "browse.html",
        simulated=_all_simulated(matches),
        query=query,
        campaigns=campaigns,
        statuses=STATUS,
        captures=Listed.of(
            [e for e in matches if e.kind in ("capture", "unreadable")],
            "captures",
            request,
            {"campaign": partial(_campaign_of, [view.name for view in views]), "sample": lambda e: e.sample},
        ),
        notes=notes,
        products=products,
        sources=[inputs_of(e, entries, library.root) for e in products.entries],
        found=len(matches),
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
        resumes=resume_preview(pages.library.root / view.name),
    )


def _campaign(library: Library, folder: Path) -> CampaignView:
    run = running_in(folder)
    view = read_campaign(folder, library, None if run is None else run.get("capture"))
    if view is None:
        raise NotHere(f"{library.name(folder)}: no campaign was begun in this folder")
    return view
