"""`acquire --omega 35` and `acquire --resume FILE`: one capture, from the options to the summary."""

import contextlib
import os
import shlex
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import typer
from rich.console import Console

from acquisition.capture import session
from acquisition.capture.checks import CheckResult, refuse_failed
from acquisition.capture.estimate import capture_seconds
from acquisition.capture.free_name import free_name
from acquisition.capture.header import default_name
from acquisition.capture.identity import rig_content
from acquisition.capture.job import Job, Result, check_with_devices, job_of, prepare, stored_plan, stored_rig
from acquisition.capture.machine_checks import check_machine
from acquisition.capture.operator import Operator
from acquisition.capture.partial_file import PARTIAL, seal_whole
from acquisition.capture.plan import MeasurementPlan
from acquisition.capture.state_file import wait_until_free
from acquisition.capture.synced import make_folder
from acquisition.commands.defaults import CONFIGS, DEFAULT_RIG, INTERRUPTED
from acquisition.disc import disc_process, on_disc
from acquisition.errors import AcquisitionError
from acquisition.rig.config import RigConfig, load_rig
from acquisition.rig.guarded import GUARD_LOG
from acquisition.rig.open_rig import open_rig
from acquisition.rig.own_rigs import note_rig, own_rigs
from acquisition.screen.notify import notifying
from acquisition.screen.observer import Observer
from acquisition.screen.progress import ConsoleProgress
from acquisition.screen.rows import print_rows, say
from acquisition.screen.run_file import RunFile
from acquisition.stop_request import StopRequest
from processing.doors import one_line
from processing.errors import ProcessError
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import Sample
from processing.yaml_file import ConfigError


@dataclass(frozen=True)
class Options:
    """The options of `acquire` without a subcommand."""

    omega: float | None
    mode: str | None
    wavelength: float | None
    sample: str | None
    exposure: float | None
    rig: Path | None
    plan: Path | None
    out: Path
    seed: int | None
    dry_run: bool
    home: bool
    resume: Path | None
    as_new: bool
    live: bool
    yes: bool

    def given(self, *names: str) -> list[str]:
        """Those of these options that are there."""
        return [name for name in names if getattr(self, name) is not None]


def run(options: Options, stop: StopRequest) -> int:
    """Take or continue one capture; returns the exit code. Raises the errors that `main` prints."""
    with disc_process():
        return _run(options, stop)


def _run(options: Options, stop: StopRequest) -> int:
    console = Console(stderr=True)
    if (
        options.resume is not None
        and (sealed := on_disc(f"look at {options.resume}", _seal_if_whole, options.resume)) is not None
    ):
        typer.echo(f"all states were complete; sealed as {sealed}")
        return 0
    job, path, resuming = _job(options)
    sample = job.plan.sample.name or job.plan.sample.kind
    say_simulated(console, job.rig)
    operator = Operator(partial(say, console), stop, options.yes, job.rig.simulated)
    with open_rig(job.rig, ask=operator.confirm) as rig:
        checks = [*check_machine(job.rig, [sample]), *check_with_devices(job, rig, path.parent)]
        if options.dry_run:
            show_checks(Console(), (*job.checks, *checks))
            refuse_failed(checks)
            say(Console(), f"about {capture_seconds(job, rig):.0f} s; nothing was moved")
            return 0
        refuse_failed(checks)
        if stop.requested:
            return INTERRUPTED
        take = session.resume if resuming else session.take
        run_file = RunFile(path.parent, job.rig.simulated)
        on_disc(f"make {path.parent}", make_folder, path.parent)
        rig.start_guard(path.parent / GUARD_LOG)
        with (
            nullcontext(path) if resuming else free_name(path) as path,
            notifying(job.rig.notify, path, job.rig.simulated) as notifier,
            live_page(options.live, job.rig, stop, console) as page,
            run_file,
        ):
            observers = [ConsoleProgress(console), run_file, notifier, *page]
            result = take(job, rig, path, stop, observers=observers, home=options.home)
            notifier.tell("end", f"{path.name}: {result.states_done} of {result.states} states, {result.status}")
    summarize(job, result)
    return INTERRUPTED if result.status == "aborted" else 0


def _job(options: Options) -> tuple[Job, Path, bool]:
    """The job, its file or the preferred name of a new one, and whether the file is resumed."""
    if options.resume is None:
        if options.out.suffix == ".h5":
            raise ConfigError(
                f"--out {options.out} would be a folder: captures get their names from time, sample and angle. "
                f"Give the folder: --out {options.out.parent}"
            )
        job = prepare(plan_of(options), rig_of(options))
        return job, options.out / default_name(job.plan), False
    _refuse_with_resume(options)
    with Capture(options.resume) as capture:
        plan = stored_plan(capture)
        rig = load_user_rig(options.rig) if options.rig else own_rig_of(capture, options.as_new)
    if not options.as_new:
        return job_of(options.resume, rig), options.resume, True
    return prepare(plan, rig), options.resume.with_name(options.resume.name.removesuffix(PARTIAL)), False


def own_rig_of(capture: Capture, exactly: bool) -> RigConfig:
    """The user's own rig file that a capture was begun with, as far as its content tells.

    Parameters
    ----------
    exactly : False for one of the same name if none has the same content.

    Raises
    ------
    ConfigError
        There is none. The rig in the capture is not used: its commands and paths may be those of another user.
    """
    stored, mode = stored_rig(capture), capture.header.mode
    equal = []
    for file in (*own_rigs(stored.name), DEFAULT_RIG):
        with contextlib.suppress(ProcessError):
            rig = load_rig(file).with_seed(stored.seed)
            if mode in rig.modes and rig_content(rig, mode) == rig_content(stored, mode):
                return rig
            if file != DEFAULT_RIG:
                equal.append(rig)
    if equal and not exactly:
        return equal[0]
    path = one_line(capture.path)
    raise ConfigError(
        f"{path} was begun with rig {one_line(stored.name)!r}, and you have not used such a rig file before. Devices, "
        f"commands and paths are not taken from a data file. Give yours: acquire --resume {shlex.quote(path)} "
        f"--rig RIG.yaml{' --as-new' if exactly else ''}"
    )


def load_user_rig(file: Path) -> RigConfig:
    """Read a rig file that the user has given, and note that it is theirs. Raises ConfigError."""
    rig = load_rig(file)
    note_rig(file, rig.name)
    return rig


def _seal_if_whole(path: Path) -> Path | None:
    wait_until_free(path)
    return seal_whole(path) if path.name.endswith(PARTIAL) and path.exists() else None


def _refuse_with_resume(options: Options) -> None:
    """A capture that is resumed has its plan in its file."""
    flags = options.given("omega", "mode", "wavelength", "sample", "exposure", "plan", "seed")
    if flags:
        raise ConfigError(
            f"--{flags[0]} has no meaning with --resume: the plan is in {options.resume}. Leave it out, or take a new "
            "capture without --resume."
        )


def plan_of(options: Options) -> MeasurementPlan:
    """The plan file, or the default plan of the mode, with the options on top."""
    path = options.plan or CONFIGS / "plans" / f"{options.mode or 'drr'}.yaml"
    if options.plan is None and not path.exists():
        modes = ", ".join(sorted(p.stem for p in (CONFIGS / "plans").glob("*.yaml")))
        raise ConfigError(f"--mode {options.mode}: there is no default plan of that name, only {modes}. Give --plan.")
    plan = MeasurementPlan.load(path)
    sample = None if options.sample is None else sample_of(options.sample)
    return plan.with_changes(
        omega_deg=options.omega, wavelength_nm=options.wavelength, sample=sample, exposure_s=options.exposure
    )


def sample_of(name: str) -> Sample:
    """A sample by its name; air and mirror are known ones."""
    if name == "air":
        return Sample(kind="air", name=name)
    if name == "mirror":
        return Sample(kind="mirror", name=name)
    return Sample(name=name)


def rig_of(options: Options) -> RigConfig:
    """The rig file, or the simulated rig."""
    return load_user_rig(options.rig or DEFAULT_RIG).with_seed(options.seed)


@contextmanager
def live_page(enabled: bool, rig: RigConfig, stop: StopRequest, console: Console) -> Iterator[list[Observer]]:
    """The live page as a list of observers, empty where it is not wanted; prints its address."""
    if not enabled:
        yield []
        return
    from acquisition.screen.live_view import LiveView

    full_scale = (1 << (rig.detector.bits or 16)) - 1
    with LiveView(rig.simulated, rig.detector.black_level_counts, full_scale, stop) as view:
        say(console, f"live view: {view.url}")
        yield [view]


def say_simulated(console: Console, rig: RigConfig) -> None:
    """Say on the console that nothing of this is a measurement."""
    if rig.simulated:
        say(console, f"SIMULATED: rig {rig.name!r}, emulated devices, no hardware", "bold red")


def show_checks(console: Console, checks: tuple[CheckResult, ...]) -> None:
    """One line for each check."""
    print_rows((("ok" if check.passed else "REFUSED", check.title, check.detail) for check in checks), console)


def summarize(job: Job, result: Result) -> None:
    """Draw the quick look and print one screen."""
    try:
        figure = str(on_disc("draw the quick look", _draw_quicklook, result.path))
    except (OSError, AcquisitionError) as error:
        # The capture is whole: a picture less is no reason to call it failed.
        figure = f"not drawn ({getattr(error, 'strerror', None) or error}); the capture is whole"
    plan, ledger = job.plan, result.ledger
    darks = sum(role == "dark" for role in job.table.role)
    title = f"{plan.mode}, {plan.wavelength_nm:g} nm, Omega {plan.omega_deg:g} deg, {plan.sample.name}"
    lines = [
        ("what", ("SIMULATED " if job.rig.simulated else "") + title),
        ("states", f"{result.states_done} of {result.states} ({darks} dark), {result.status}"),
        ("angles", f"read back at every state, at most {result.worst_angle_deg:.4f} deg from the target"),
        ("saturation", f"worst state {100 * result.saturated_fraction:.3f} % of pixels"),
        ("seconds", f"{ledger['total_s']:.1f} in all: {', '.join(_steps(ledger))}"),
        *(("overhead", text) for text in _overhead(ledger)),
        *(("note", message) for message in result.messages[-5:]),
        ("figure", figure),
        ("capture", str(result.path)),
        ("next", next_command(result)),
    ]
    for label, text in lines:
        typer.echo(f"{label:<11} {text}")


def _draw_quicklook(path: Path) -> Path:
    from acquisition.screen import quicklook

    return quicklook.draw(path)


def _steps(ledger: dict[str, float]) -> list[str]:
    """Seconds of each kind of step that took 0.1 or more, the longest first."""
    sums = ("total_s", "unavoidable_s", "of_it_readout_s")
    times = {name.removesuffix("_s"): ledger[name] for name in ledger if name.endswith("_s") and name not in sums}
    return [f"{name} {times[name]:.1f}" for name in sorted(times, key=lambda n: -times[n]) if times[name] >= 0.05]


def _overhead(ledger: dict[str, float]) -> list[str]:
    # Emulators of another program can run faster than the speeds that they declare.
    if ledger.get("excess", -1.0) < 0:
        return []
    readout_ms = 1e3 * ledger["of_it_readout_s"] / max(ledger["states"], 1)
    return [
        f"{100 * ledger['excess']:.1f} % beyond the unavoidable {ledger['unavoidable_s']:.1f} s of moves, settling, "
        f"exposure and the camera's own {readout_ms:.0f} ms a state"
    ]


def next_command(result: Result) -> str:
    """What to do with the file now, as the user started this program: `UMOV_DOOR` is set by ./lab."""
    words = ["process", "reduce"] if result.status == "complete" else ["acquire", "--resume"]
    return shlex.join(filter(None, [os.environ.get("UMOV_DOOR"), *words, str(result.path)]))
