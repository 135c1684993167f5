"""`process reduce`: a capture to a Mueller or Stokes image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the commands of this module."""
    app.command("reduce")(reduce_command)


def reduce_command(
    capture: Annotated[Path, typer.Argument(help="Capture file (HDF5).")],
    instrument: Annotated[
        Path | None, typer.Option(help="Instrument file to use instead of the one in the capture.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Product file; default: beside the capture.")] = None,
) -> None:
    """Invert W per pixel: Mueller image, or Stokes image of a polarization mosaic, with standard errors."""
    raise NotImplementedError
