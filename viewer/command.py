"""The `view` command."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from processing.commands.command_line import Version, application, run

app = application("view", "Look at captures, campaigns and products in the browser.")


@app.command()
def view(
    folder: Annotated[Path, typer.Argument(help="Folder with captures, campaigns and products.")] = Path("captures"),
    port: Annotated[int, typer.Option(help="On this machine; 0: any that is free.")] = 0,
    browser: Annotated[bool, typer.Option("--open", help="Open the page in the browser as well.")] = False,
    version: Version = False,
) -> None:
    """Serve the pages to a browser on this machine until Ctrl-C; captures and campaigns started there go on."""
    # A capture that is being written is locked against other programs; what is marked done in it may be read all the
    # same, and whoever looks must never keep a run from its file. HDF5 reads this when it is loaded.
    os.environ["HDF5_USE_FILE_LOCKING"] = "FALSE"
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from viewer.server import serve

    serve(folder, port, browser)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `view`; ends in SystemExit."""
    run(app, argv)


if __name__ == "__main__":
    main()
