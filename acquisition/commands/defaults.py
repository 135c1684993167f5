"""Shared by the commands of `acquire`: files that come with the program, the rig option, the exit code of a stop."""

from pathlib import Path
from typing import Annotated

import typer

#: In the checkout a link to `configs/`, in the wheel the files themselves.
CONFIGS = Path(__file__).resolve().parents[1] / "configs"
DEFAULT_RIG = CONFIGS / "rigs" / "simulated.yaml"
#: Exit code after Ctrl-C or the stop button.
INTERRUPTED = 130

RigFile = Annotated[Path | None, typer.Option("--rig", help="rig file; without it the SIMULATED rig")]
