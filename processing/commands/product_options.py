"""Options of the commands that write a product."""

from pathlib import Path
from typing import Annotated

import typer

ProductFile = Annotated[Path | None, typer.Option("--out", help="Product file; default: beside the input.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace a product of that name.")]
