"""`process import` and `process colours`: captures made of data measured elsewhere, or of another capture."""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from processing.commands.batch import Output, files_of, place_for, run_batch
from processing.commands.command_line import DATA, command
from processing.commands.recipe import read_recipe, recipe_text
from processing.errors import ProcessError
from processing.whole_file import write_whole_text

if TYPE_CHECKING:
    from processing.steps.file_step import Progress


class AngleUnit(StrEnum):
    """Units of the angles of other labs."""

    degrees = "degrees"
    radians = "radians"


@command("import", DATA)
def import_command(
    *,
    context: typer.Context,
    wavelength_nm: Annotated[float, typer.Option(help="Wavelength of the measurement.")],
    items: Annotated[
        list[str] | None,
        typer.Argument(
            help="Measurements with these options, a capture of each: stacks in place of --stack, or what {item} "
            "stands for in --stack, --states, --columns and --darks."
        ),
    ] = None,
    states: Annotated[
        Path | None,
        typer.Option(
            help="CSV: state, a column <axis>_deg for each axis; optional time_s, exposure_s, sigma, role, file, "
            "channel_<name>."
        ),
    ] = None,
    columns: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=COLUMN",
            help="Where the numbers of NAME (an axis, file, time_s ...) are: a column of the CSV, or an array such as "
            "FILE.h5::/angles[0]. Repeat for each. Other columns are then ignored.",
        ),
    ] = None,
    angles: Annotated[AngleUnit | None, typer.Option(help="Unit of the angles.")] = None,
    stack: Annotated[
        str | None,
        typer.Option(
            help="All frames: .npy, AxoStep's .rmmd, FILE.mat::NAME, HDF5 as FILE::/dataset, a folder, or a pattern "
            "such as 'run/*.tif' (frame 2 before frame 10)."
        ),
    ] = None,
    darks: Annotated[str | None, typer.Option(help="Dark frames, given as --stack.")] = None,
    instrument: Annotated[Path | None, typer.Option(help="Instrument file (YAML).")] = None,
    sample: Annotated[
        str, typer.Option(help="air, mirror, unknown, or a file with 16 numbers (row-major).")
    ] = "unknown",
    repeats: Annotated[int, typer.Option(min=1, help="Frames of each state, one after the other.")] = 1,
    omega_deg: Annotated[float | None, typer.Option(help="Angle of the source arm.")] = None,
    black_level: Annotated[float, typer.Option(help="Pedestal in counts.")] = 0.0,
    gain_e_per_count: Annotated[
        float | None, typer.Option(help="Electrons a count; gives error bars from the noise.")
    ] = None,
    read_noise_e: Annotated[float | None, typer.Option(help="Read noise in electrons.")] = None,
    bits: Annotated[int | None, typer.Option(help="Bits of the counts; default: of the file's type.")] = None,
    title: Annotated[str, typer.Option(help="Title to keep in the file.")] = "",
    out: Annotated[
        Path | None,
        typer.Option(help="Capture to write; default: states file's name with .h5. Of several ITEMS: a folder."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a capture of that name.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the states as understood, draw the frames, write no capture.")
    ] = False,
    recipe: Annotated[
        Path | None,
        typer.Option(
            is_eager=True,
            callback=read_recipe,
            help="YAML file with the options of an earlier import; an option given here wins.",
        ),
    ] = None,
) -> None:
    """Make captures out of frames or fluxes measured elsewhere. One row of states.csv is one state.

    The options are kept beside the capture in NAME.import.yaml, for `--recipe`. A capture that is newer than its data
    and was made with the same options is not made again.
    """
    from processing.commands.loaded_late.import_preview import show_understood
    from processing.storage.captures.schema import Detector
    from processing.storage.formats.foreign_arrays import ImportFailed
    from processing.storage.formats.import_request import ImportRequest, for_item, name_of_item, read_sample
    from processing.storage.formats.importing import import_capture, is_imported

    if gain_e_per_count is not None and gain_e_per_count <= 0:
        raise ImportFailed(f"--gain-e-per-count {gain_e_per_count:g}: must be above 0")
    if read_noise_e is not None and read_noise_e < 0:
        raise ImportFailed(f"--read-noise-e {read_noise_e:g}: must not be negative")
    named = dict(_name_and_column(text) for text in columns or ())
    first = states or Path(next((t.partition("::")[0] for t in named.values() if "::" in t), stack or "imported"))
    request = ImportRequest(
        states=states,
        out=out or first.with_suffix(".h5"),
        wavelength_nm=wavelength_nm,
        stack=stack,
        instrument=instrument,
        sample=read_sample(sample),
        detector=Detector(
            black_level_counts=black_level, gain_e_per_count=gain_e_per_count, read_noise_e=read_noise_e, bits=bits
        ),
        omega_deg=omega_deg,
        title=title,
        overwrite=overwrite,
        columns=named,
        angles=angles.value if angles else None,
        darks=darks,
        repeats=repeats,
    )
    requests = {first: request}
    if items:
        place = place_for([Path(item) for item in items], out)
        requests = {
            Path(item): replace(for_item(request, item), out=place(name_of_item(item))) for item in dict.fromkeys(items)
        }
    if dry_run:
        for item, job in requests.items():
            if items:
                typer.echo(f"{item}:")
            show_understood(job)
        return
    sources: dict[Path, Path] = {}

    def make(item: Path, tick: Progress) -> Output:
        job = requests[item]
        if (twin := sources.setdefault(job.out, item)) != item:
            raise ProcessError(f"its capture {job.out} is that of {twin} too. Import one of them with another --out.")
        file, text = job.out.with_suffix(".import.yaml"), recipe_text(context, job)
        is_same = file.is_file() and file.read_text(encoding="utf-8", errors="replace") == text
        if is_same and not overwrite and is_imported(job):
            return Output((job.out,), True)
        import_capture(job, tick)
        write_whole_text(file, text)
        return Output((job.out,), False)

    run_batch("importing", "states", list(requests), make, print_result=_print_imported)


def _print_imported(output: Output) -> None:
    from processing.storage.captures.capture import Capture

    (path,) = output.paths
    with Capture(path) as capture:
        header = capture.header
        count = 0 if capture.angles_deg else capture.states_with("sample").size
    typer.echo(f"{path}: {header.title}, {header.wavelength_nm:g} nm, sample {header.sample.kind}")
    if count > 1:
        typer.echo(
            f"{count} frames in which nothing turns: `reduce` averages them. If each is a scene, give the files "
            "themselves in place of --stack"
        )
    typer.echo(f"recipe: {path.with_suffix('.import.yaml')}")


def _name_and_column(text: str) -> tuple[str, str]:
    name, equals, column = text.partition("=")
    if not (equals and name and column):
        raise typer.BadParameter(f"{text!r}: write NAME=COLUMN, as psg='angle (deg)'", param_hint="--columns")
    return name.strip(), column.strip()


@command("colours", DATA)
def colours_command(
    captures: Annotated[
        list[Path], typer.Argument(help="Captures of a sensor with a colour filter, or folders of them.")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for the captures; default: that of the capture.")] = None,
) -> None:
    """Split each capture of a colour sensor into one for each colour: red, green_a, green_b, blue."""
    from processing.storage.captures.capture import Capture, made_of_captures
    from processing.storage.captures.colour_split import split_colours

    def has_colours(path: Path) -> bool:
        if made_of_captures(path):
            return False
        with Capture(path) as capture:
            return capture.header.colours is not None

    inputs = files_of(captures, has_colours, "captures of a colour sensor")

    def make(capture: Path, _: object) -> Output:
        paths, is_unchanged = split_colours(capture, out or capture.parent)
        return Output(tuple(paths), is_unchanged)

    run_batch("splitting", "captures", inputs, make)
