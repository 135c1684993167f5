"""The `data` command: public measured data by name, and the captures that they make."""

import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from processing.commands.command_line import Version, application, run

app = application("data", "Public measured data: list them, get them by name, make captures of them.")


@app.callback(no_args_is_help=True)
def _data(version: Version = False) -> None:
    pass


@app.command("list")
def list_command() -> None:
    """Every set: its name, title, licence, source and citation."""
    from processing.public_data.sets import catalogue

    for name, entry in catalogue().items():
        typer.echo(f"{name}\n  {entry.title}")
        typer.echo(f"  licence {entry.licence}; {entry.source} at {entry.commit[:12]}")
        typer.echo(f"  {entry.citation}{f' doi:{entry.doi}' if entry.doi else ''}")
        if entry.in_repository:
            typer.echo(f"  in the repository (tests/data/{name}): {entry.in_repository}")


@app.command("get")
def get_command(
    name: Annotated[str, typer.Argument(help="Name of a set, see `data list`.")],
    out: Annotated[Path | None, typer.Option(help="Folder for files and captures; default: data/NAME.")] = None,
) -> None:
    """Download a set (or find it in the folder UMOV_DATA), check its SHA-256, and make captures of it."""
    from acquisition.commands.defaults import CONFIGS
    from processing.commands.batch import Output, run_batch
    from processing.commands.progress_bar import progress_bar
    from processing.public_data.conversion import tables_of
    from processing.public_data.sets import catalogue, get_files
    from processing.storage.formats.import_request import ImportRequest, read_sample
    from processing.storage.formats.importing import import_capture

    folder = out or Path("data") / name
    with progress_bar(f"getting {name}", "files") as tick:
        files = get_files(name, folder, tick)
    entry = catalogue()[name]
    typer.echo(f"{name}: {len(files)} files, each with the SHA-256 of the catalogue")
    typer.echo(f"  licence: {entry.licence}\n  cite: {entry.citation}{f' doi:{entry.doi}' if entry.doi else ''}")
    if entry.note:
        typer.echo(f"  {entry.note}")
    tables = {folder / f"{table.name}.h5": table for table in tables_of(name, files)}
    if not tables:
        typer.echo("\n".join(map(str, files.values())))
        return
    folder.mkdir(parents=True, exist_ok=True)
    instrument = CONFIGS / "instruments" / entry.instrument

    def make(capture: Path, progress: object) -> Output:
        table = tables[capture]
        states, is_same = table.write(folder)
        if is_same and capture.exists():
            return Output((capture,), True)
        request = ImportRequest(
            states=states,
            out=capture,
            wavelength_nm=table.wavelength_nm,
            instrument=instrument,
            sample=read_sample(table.sample),
            title=f"{name}, {table.name}",
        )
        import_capture(request)
        return Output((capture,), False)

    run_batch("importing", "states", list(tables), make)
    first = next((path for path, table in tables.items() if table.sample != "unknown"), next(iter(tables)))
    words = ["process", "reduce", str(first)]
    if tables[first].sample != "unknown":
        words = ["diagnose", str(first), "--instrument", str(instrument)]
    typer.echo("next: " + shlex.join([os.environ.get("UMOV_DOOR", "umov"), *words]))


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `data`; ends in SystemExit."""
    run(app, argv)


if __name__ == "__main__":
    main()
