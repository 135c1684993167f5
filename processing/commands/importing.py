"""`process import` and `process colours`: captures made of data measured elsewhere, or of another capture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from processing.commands.batch import Made, files_of, run_batch


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("import")(import_command)
    app.command("colours")(colours_command)


def import_command(
    states: Annotated[
        Path,
        typer.Option(
            help="CSV: state, a column <axis>_deg for each axis; optional time_s, exposure_s, sigma, role, file, "
            "channel_<name>."
        ),
    ],
    wavelength_nm: Annotated[float, typer.Option(help="Wavelength of the measurement.")],
    stack: Annotated[
        str | None, typer.Option(help="All frames in one file: .npy, AxoStep's .rmmd, or HDF5 as FILE::/dataset.")
    ] = None,
    instrument: Annotated[Path | None, typer.Option(help="Instrument file (YAML).")] = None,
    sample: Annotated[
        str, typer.Option(help="air, mirror, unknown, or a file with 16 numbers (row-major).")
    ] = "unknown",
    omega_deg: Annotated[float | None, typer.Option(help="Angle of the source arm.")] = None,
    black_level: Annotated[float, typer.Option(help="Pedestal in counts.")] = 0.0,
    gain_e_per_count: Annotated[
        float | None, typer.Option(help="Electrons a count; gives error bars from the noise.")
    ] = None,
    read_noise_e: Annotated[float | None, typer.Option(help="Read noise in electrons.")] = None,
    bits: Annotated[int | None, typer.Option(help="Bits of the counts; default: of the file's type.")] = None,
    title: Annotated[str, typer.Option(help="Title to keep in the file.")] = "",
    out: Annotated[Path | None, typer.Option(help="Capture to write; default: states file's name with .h5.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a capture of that name.")] = False,
) -> None:
    """Make a capture out of frames or fluxes measured elsewhere. One row of states.csv is one state."""
    from processing.commands.progress_bar import progress_bar
    from processing.storage.capture_schema import Detector
    from processing.storage.importing import ImportRequest, import_capture, read_sample
    from processing.storage.state_csv import ImportFailed

    if gain_e_per_count is not None and gain_e_per_count <= 0:
        raise ImportFailed(f"--gain-e-per-count {gain_e_per_count:g}: must be above 0")
    if read_noise_e is not None and read_noise_e < 0:
        raise ImportFailed(f"--read-noise-e {read_noise_e:g}: must not be negative")
    request = ImportRequest(
        states=states,
        out=out or states.with_suffix(".h5"),
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
    )
    with progress_bar("importing", "states") as tick:
        header = import_capture(request, tick, lambda text: typer.echo(f"warning: {text}", err=True))
    typer.echo(f"{request.out}: {header.title}, {header.wavelength_nm:g} nm, sample {header.sample.kind}")


def colours_command(
    captures: Annotated[
        list[Path], typer.Argument(help="Captures of a sensor with a colour filter, or folders of them.")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder for the captures; default: that of the capture.")] = None,
) -> None:
    """Split each capture of a colour sensor into one for each colour: red, green_a, green_b, blue."""
    from processing.storage.capture import Capture, made_of_captures
    from processing.storage.colour_split import split_colours

    def has_colours(path: Path) -> bool:
        if made_of_captures(path):
            return False
        with Capture(path) as capture:
            return capture.header.colours is not None

    inputs = files_of(captures, has_colours, "captures of a colour sensor")

    def make(capture: Path, _: object) -> Made:
        paths, is_unchanged = split_colours(capture, out or capture.parent)
        return Made(tuple(paths), is_unchanged)

    run_batch("splitting", "captures", inputs, make)
