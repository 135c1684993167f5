"""Jobs that a page starts: a campaign, a reduction, the maps of a product, a diagnosis; and their progress."""

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, StreamingResponse

from acquisition import CONFIGS, Campaign
from acquisition.campaign.identity import read_identity
from acquisition.campaign.log import PLAN
from acquisition.commands.defaults import DEFAULT_RIG
from acquisition.rig.config import load_rig
from acquisition.rig.own_rigs import is_own_rig, own_campaign
from processing.errors import ProcessError
from processing.reflectance.base import kinds
from processing.storage.captures.capture import Capture
from viewer.diagnoses import Diagnoses
from viewer.event_stream import event_stream
from viewer.jobs import Jobs, PageJob
from viewer.library import Library, NotHere
from viewer.pages import Pages, fields_of, pages_of


def jobs_of(request: Request) -> Jobs:
    """The commands started in the folder of the application."""
    return Jobs(pages_of(request).library.root)


async def start(request: Request) -> JSONResponse:
    """Start the job that the page requests; answers with the address of the page that follows it."""
    fields = await fields_of(request)
    pages = pages_of(request)
    kind = fields.get("what", "")
    if kind not in KINDS:
        raise ProcessError(f"{kind!r} cannot be started; there are {', '.join(KINDS)}")
    job = await run_in_threadpool(KINDS[kind], pages.library, jobs_of(request), fields)
    return JSONResponse({"address": pages.address("job", name=job.name)})


def _campaign(library: Library, jobs: Jobs, fields: dict[str, str]) -> PageJob:
    file = campaign_files(library).get(fields.get("file", ""))
    if file is None:
        raise NotHere(f"{fields.get('file')}: there is no such campaign file")
    campaign = Campaign.load(file)
    rig = campaign.rig or DEFAULT_RIG
    if not (is_own_rig(rig) or rig.resolve().is_relative_to(CONFIGS.resolve())):
        raise ProcessError(
            f"{file.name} names the rig file {rig}, which you have not used before, and a rig file names devices and "
            f"commands. Look at it, then use it once in a terminal: acquire --campaign {shlex.quote(str(file))} "
            f"--rig {shlex.quote(str(rig))} --dry-run"
        )
    command = ["acquire", "--campaign", str(file), "--rig", str(rig), "--out", str(library.root)]
    if fields.get("yes"):
        command.append("--yes")
    return jobs.start(f"campaign {campaign.name}", command, {"campaign": campaign.name}, library.root)


def campaign_files(library: Library) -> dict[str, Path]:
    """Campaign files that can be started, by the name that a page shows: those of the folder, and the examples."""
    paths = [path for path in library.yaml_files("kind: campaign") if path.name != PLAN]
    return {library.name(path): path for path in paths} | {
        f"example: {path.stem}": path for path in sorted((CONFIGS / "campaigns").glob("*.yaml"))
    }


def _resume(library: Library, jobs: Jobs, fields: dict[str, str]) -> PageJob:
    folder = library.path(fields.get("folder", ""))
    if read_identity(folder) is None:
        raise NotHere(f"{fields.get('folder')}: no campaign was begun in this folder")
    command = resume_command(folder)
    if command is None:
        raise ProcessError(
            f"{folder.name} was not begun by you on this machine, and what it names is not run. In a terminal: acquire "
            f"--campaign {shlex.quote(str(folder / PLAN))} --rig RIG.yaml --out {shlex.quote(str(folder.parent))}"
        )
    return jobs.start(f"campaign {folder.name}, resumed", command, {"campaign": library.name(folder)}, library.root)


def resume_command(folder: Path) -> list[str] | None:
    """The command that resumes the campaign in a folder, with the user's own files; None where it is not theirs."""
    files = own_campaign(folder)
    if files is None:
        return None
    campaign, rig = files
    # A folder that is the second of its name is found by the same command with --as-new.
    more = [] if folder.name == Campaign.load(campaign).name else ["--as-new"]
    return ["acquire", "--campaign", str(campaign), "--rig", str(rig), "--out", str(folder.parent), *more]


def resume_preview(folder: Path) -> tuple[str, list[str]] | None:
    """The command that resumes the campaign in a folder, as typed, and the commands that its rig file names.

    None where the campaign is not the user's own.
    """
    try:
        command = resume_command(folder)
        if command is None:
            return None
        rig = load_rig(command[command.index("--rig") + 1])
    except ProcessError:
        return None
    commands = [rig.alert, rig.notify.command if rig.notify else (), (rig.notify and rig.notify.webhook) or ""]
    return shlex.join(command), [entry if isinstance(entry, str) else shlex.join(entry) for entry in commands if entry]


def _reduce(library: Library, jobs: Jobs, fields: dict[str, str]) -> PageJob:
    capture = library.path(fields.get("file", ""))
    command = ["process", "reduce", str(capture)]
    if (file := _instrument(library, fields)) is not None:
        with Capture(capture) as opened:
            out = capture.with_name(f"{capture.stem}.{file.stem}.{opened.reduces_to}.h5")
        command += ["--instrument", str(file), "--out", str(out)]
    return jobs.start(f"reduce {capture.name}", command, {"file": library.name(capture)}, library.root)


def _quantities(library: Library, jobs: Jobs, fields: dict[str, str]) -> PageJob:
    product = library.path(fields.get("file", ""))
    about = {"file": library.name(product)}
    return jobs.start(f"maps of {product.name}", ["process", "quantities", str(product)], about, library.root)


def _diagnose(library: Library, jobs: Jobs, fields: dict[str, str]) -> PageJob:
    captures = [library.path(name) for name in fields.get("files", "").split("\n") if name]
    name, folder = Diagnoses(library).begin(captures, _instrument(library, fields))
    more = ["--residuals", str(folder / "residuals.npz")]
    return _diagnosis(library, jobs, captures, name, folder=folder, more=more)


def _surface(library: Library, jobs: Jobs, fields: dict[str, str]) -> PageJob:
    captures = [library.path(name) for name in fields.get("files", "").split("\n") if name]
    material = _chosen(material_files(library), fields.get("material", ""), "material")
    geometry = _chosen(geometry_files(library), fields.get("geometry", ""), "geometry")
    name, folder = Diagnoses(library).begin(captures, _instrument(library, fields), (material, geometry))
    more = ["--reflectance", str(folder / "material.yaml"), "--geometry", str(folder / "geometry.yaml")]
    return _diagnosis(library, jobs, captures, name, folder=folder, more=more)


def _diagnosis(
    library: Library, jobs: Jobs, captures: list[Path], name: str, *, folder: Path, more: list[str]
) -> PageJob:
    command = ["diagnose", *map(str, captures), "--instrument", str(folder / "instrument.yaml")]
    command += ["--json", str(folder / "diagnosis.json"), "--report", str(folder / "report.html"), *more]
    about = {"diagnosis": name, "file": library.name(captures[0])}
    return jobs.start(f"diagnose {', '.join(c.name for c in captures)}", command, about, library.root)


def instrument_files(library: Library) -> dict[str, Path]:
    """Instrument files by the name that a page shows: those of the folder, and those that come with the program."""
    return _with_examples(library, library.yaml_files("kind: instrument"), "instruments")


def material_files(library: Library) -> dict[str, Path]:
    """Material files, as `instrument_files`."""
    paths = [path for kind in kinds() for path in library.yaml_files(f"kind: {kind}")]
    return _with_examples(library, paths, "materials")


def geometry_files(library: Library) -> dict[str, Path]:
    """Geometry files, as `instrument_files`."""
    return _with_examples(library, library.yaml_files("source_distance_mm:"), "geometries")


def _with_examples(library: Library, paths: list[Path], folder: str) -> dict[str, Path]:
    files = {library.name(path): path for path in paths}
    return files | {f"example: {path.stem}": path for path in sorted((CONFIGS / folder).glob("*.yaml"))}


def _instrument(library: Library, fields: dict[str, str]) -> Path | None:
    """The instrument file that a page chose; None for the model in the capture. Raises NotHere."""
    name = fields.get("instrument")
    return _chosen(instrument_files(library), name, "instrument") if name else None


def _chosen(files: dict[str, Path], name: str, kind: str) -> Path:
    if name not in files:
        raise NotHere(f"{name}: there is no such {kind} file")
    return files[name]


KINDS: dict[str, Callable[[Library, Jobs, dict[str, str]], PageJob]] = {
    "campaign": _campaign,
    "resume": _resume,
    "reduce": _reduce,
    "quantities": _quantities,
    "diagnose": _diagnose,
    "surface": _surface,
}


def job(request: Request) -> HTMLResponse:
    """The page of a job."""
    pages, jobs = pages_of(request), jobs_of(request)
    entry = jobs.job(request.query_params.get("name", ""))
    return pages.draw("job.html", simulated=_simulated(pages, entry), job=entry, now=job_state(pages, jobs, entry))


def _simulated(pages: Pages, page_job: PageJob) -> bool:
    """Whether the captures that a job reads, or the devices that it drives, are simulated."""
    if "file" in page_job.about:
        return pages.library.entry(page_job.about["file"]).simulated
    rig = dict(zip(page_job.command, page_job.command[1:], strict=False)).get("--rig")
    try:
        return rig is not None and load_rig(rig).simulated
    except ProcessError:
        return False


def job_state(pages: Pages, jobs: Jobs, page_job: PageJob) -> dict[str, Any]:
    """State of a job for its page: status, output, and links to its products."""
    status = jobs.status(page_job)
    links = []
    about, library = page_job.about, pages.library
    if "campaign" in about and (library.root / about["campaign"] / PLAN).exists():
        links.append(["The campaign", pages.address("campaign", folder=about["campaign"])])
    if "diagnosis" in about and status == "done":
        links.append(["The verdict", pages.address("diagnosis", name=about["diagnosis"])])
    if "file" in about:
        entry = library.entry(about["file"])
        if status == "done" and "diagnosis" not in about:
            products = [e for e in library.entries() if e.changed_s >= page_job.begun_s and e.kind != "capture"]
            links += [[f"{e.kind}: {e.name}", link] for e in products if (link := pages.shown_at(e)) is not None]
        links.append([entry.name, pages.shown_at(entry) or pages.address("")])
    return {"status": status, "output": jobs.output(page_job), "links": links}


async def job_events(request: Request) -> StreamingResponse:
    """Server-sent events: output and status of a job, until it has ended."""
    pages, jobs = pages_of(request), jobs_of(request)
    page_job = jobs.job(request.query_params.get("name", ""))
    return event_stream(
        request, lambda: job_state(pages, jobs, page_job), lambda now: now["status"] not in ("running", "ended")
    )


async def stop_job(request: Request) -> JSONResponse:
    """Send a job what Ctrl-C sends."""
    fields, jobs = await fields_of(request), jobs_of(request)
    jobs.stop(jobs.job(fields.get("name", "")))
    return JSONResponse({"stopping": True})
