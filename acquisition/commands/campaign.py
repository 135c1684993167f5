"""`acquire --campaign FILE`: check all captures, then run the missing ones."""

import contextlib
import os
import shlex
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from acquisition.campaign import run as campaign_run
from acquisition.campaign.identity import IDENTITY, campaign_identity, folder_for, require_same_campaign, with_devices
from acquisition.campaign.log import INDEX, LOG, CampaignFolder
from acquisition.campaign.plan import Campaign
from acquisition.campaign.run import CampaignRun, Planned
from acquisition.campaign.summary import SUMMARY, summary_lines
from acquisition.capture.checks import CheckResult, refuse_failed
from acquisition.capture.operator import Operator
from acquisition.commands.defaults import DEFAULT_RIG, INTERRUPTED
from acquisition.commands.single import Options, live_page, load_user_rig, say_simulated, show_checks
from acquisition.disc import disc_process, on_disc
from acquisition.errors import AcquisitionError
from acquisition.rig.open_rig import open_rig
from acquisition.rig.own_rigs import is_own_rig, note_campaign
from acquisition.screen.notify import notifying
from acquisition.screen.observer import Observer
from acquisition.screen.progress import ConsoleProgress
from acquisition.screen.rows import print_rows, say
from acquisition.screen.run_file import RunFile
from acquisition.stop_request import StopRequest
from processing.doors import one_line
from processing.whole_file import write_whole_text
from processing.yaml_file import ConfigError


def run(options: Options, file: Path, stop: StopRequest, observers: Sequence[Observer] = ()) -> int:
    """Run a campaign or, with --dry-run, only check it; returns the exit code."""
    with disc_process():
        return _run(options, file, stop, observers)


def _run(options: Options, file: Path, stop: StopRequest, observers: Sequence[Observer]) -> int:
    console = Console(stderr=True)
    _refuse_with_campaign(options, file)
    campaign = Campaign.load(file)
    rig_file = options.rig or _rig_of(campaign, file) or DEFAULT_RIG
    rig_config = load_user_rig(rig_file).with_seed(options.seed)
    jobs = campaign_run.prepare(campaign, rig_config)
    identity = campaign_identity(campaign, jobs, rig_config, rig_file.resolve())
    folder = folder_for(options.out / campaign.name, identity, options.as_new)
    say_simulated(console, rig_config)
    with open_rig(rig_config) as rig, console.status(f"checking {len(jobs)} captures"):
        identity = with_devices(identity, rig)
        require_same_campaign(folder, identity)
        planned, checks = campaign_run.check_all(jobs, rig, folder)
    if options.dry_run:
        _show(planned, checks, folder)
        refuse_failed(checks)
        return 0
    refuse_failed(checks)
    books = CampaignFolder(folder, campaign)
    books.begin_with(identity)
    note_campaign(folder, file, rig_file)
    try:
        operator = Operator(partial(say, console), stop, options.yes, rig_config.simulated)
        run_file = RunFile(folder, rig_config.simulated)
        with (
            notifying(rig_config.notify, folder, rig_config.simulated) as notifier,
            live_page(options.live, rig_config, stop, console) as page,
            run_file,
        ):
            watchers = [ConsoleProgress(console), run_file, notifier, *page, *observers]
            try:
                done = CampaignRun(
                    campaign, rig_config, books, operator, stop=stop, observers=watchers, home=options.home
                ).run(jobs)
            finally:
                lines = _sum_up(books, [capture.name for capture, _ in jobs])
            notifier.tell("end", lines[0] if done else f"stopped: {lines[0]}", summary=lines)
    finally:
        books.close()
    typer.echo("\n".join(lines))
    typer.echo(f"in {folder}: captures, {SUMMARY}, {INDEX}, {LOG}")
    words = ["process", "campaign", str(folder), "--geometry", "FILE", "--material", "FILE"]
    after = shlex.join(filter(None, [os.environ.get("UMOV_DOOR"), *words]))
    typer.echo(f"next: {after}" if done else "next: repeat the same command; it continues where it stopped")
    return 0 if done else INTERRUPTED


def _rig_of(campaign: Campaign, file: Path) -> Path | None:
    """The rig that a campaign file names; in a folder of captures, only if the user has used it before.

    Raises ConfigError: it is in a folder of captures, which may belong to another user.
    """
    if campaign.rig is None or not (file.parent / IDENTITY).exists() or is_own_rig(campaign.rig):
        return campaign.rig
    raise ConfigError(
        f"{one_line(file)} lies with captures and names the rig file {one_line(campaign.rig)}, which you have not used "
        f"before. Commands and paths are not taken from a data folder. Look at it, then give it yourself: acquire "
        f"--campaign {shlex.quote(one_line(file))} --rig RIG.yaml"
    )


def _refuse_with_campaign(options: Options, file: Path) -> None:
    """A campaign has its captures in its file: an option that changed none of them would only seem to be heard."""
    flags = options.given("omega", "mode", "wavelength", "sample", "exposure", "plan", "resume")
    if flags:
        raise ConfigError(
            f"--{flags[0]} has no meaning with --campaign: what is taken is in {file}, and what is missing of it is "
            "gone on with. Leave one of the two out."
        )


def _sum_up(held: CampaignFolder, names: Sequence[str]) -> list[str]:
    """Write the summary into the folder after every run, also a failed one, if the disc takes it."""
    try:
        return on_disc("write the summary", _write_summary, held.folder, names, held.index)
    except AcquisitionError as error:
        return [f"no summary: {error}"]


def _write_summary(folder: Path, names: Sequence[str], index: Mapping[str, Mapping[str, Any]]) -> list[str]:
    lines = summary_lines(folder, names, index)
    with contextlib.suppress(OSError):
        write_whole_text(folder / SUMMARY, "\n".join(lines) + "\n", follow=False)
    return lines


def _grouped(checks: Sequence[CheckResult]) -> tuple[CheckResult, ...]:
    """What failed, and one line for each thing that passed, with its first and last finding."""
    passed: dict[str, list[str]] = {}
    for check in checks:
        if check.passed:
            passed.setdefault(check.title, []).append(check.detail)
    lines = [
        CheckResult(name, True, texts[0] if len(texts) == 1 else f"{texts[0]} ... {texts[-1]} ({len(texts)} different)")
        for name, texts in passed.items()
    ]
    return (*(check for check in checks if not check.passed), *lines)


def _show(planned: Sequence[Planned], checks: Sequence[CheckResult], folder: Path) -> None:
    console = Console(soft_wrap=True)
    rows = [("", "capture", "states", "s", "MB", "")]
    for entry in planned:
        exists = (folder / entry.capture.name).exists()
        rows.append(
            (
                str(entry.capture.number),
                entry.capture.name,
                str(len(entry.job.table)),
                f"{entry.seconds:.0f}",
                f"{entry.size / 1e6:.0f}",
                "there already" if exists else "reference" if entry.capture.reference else "",
            )
        )
    print_rows(rows, console)
    show_checks(console, _grouped(checks))
    seconds, size = sum(p.seconds for p in planned), sum(p.size for p in planned)
    typer.echo(
        f"{len(planned)} captures, about {seconds / 60:.0f} min without homing and operator, {size / 1e9:.2f} GB; "
        "nothing was moved"
    )
