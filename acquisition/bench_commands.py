"""The rig by hand: `acquire doctor`, `home`, `move`, `stop` and `snap`."""

from __future__ import annotations

import typer


def register(app: typer.Typer) -> None:
    """Add the commands of the bench to `acquire`."""
