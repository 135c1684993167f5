"""The rig files and campaigns that this user has given to a command, as a list in the home folder.

A data file may come from another user. Devices, commands and paths are taken from these rig files, never from it.
"""

import contextlib
import json
import os
from pathlib import Path
from typing import Any

from processing.doors import read_json
from processing.errors import ProcessError

#: Entries of each kind that are kept, the last used ones.
MOST = 50


def list_file() -> Path:
    """Where the list is: `$XDG_CONFIG_HOME/umov/own.json`, by default below `~/.config`."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "umov" / "own.json"


def note_rig(file: Path, name: str) -> None:
    """Note a rig file that the user gave, with the name that stands in it."""
    _note("rigs", str(file.resolve()), name)


def note_campaign(folder: Path, file: Path, rig: Path) -> None:
    """Note that the user runs a campaign file with a rig file into a folder."""
    _note("campaigns", str(folder.resolve()), [str(file.resolve()), str(rig.resolve())])


def own_rigs(name: str) -> list[Path]:
    """The user's rig files that had this name, the last used first; only those that are still there."""
    return [Path(file) for file, its_name in _entries("rigs").items() if its_name == name and os.path.isfile(file)]


def is_own_rig(file: Path) -> bool:
    """Whether the user has given this rig file to a command."""
    return str(file.resolve()) in _entries("rigs")


def own_campaign(folder: Path) -> tuple[Path, Path] | None:
    """Campaign file and rig file with which the user began the campaign in a folder; None for that of another user."""
    files = _entries("campaigns").get(str(folder.resolve()))
    if isinstance(files, list) and len(files) == 2 and all(isinstance(file, str) for file in files):
        return Path(files[0]), Path(files[1])
    return None


def _entries(kind: str) -> dict[str, Any]:
    entries = _read().get(kind)
    return entries if isinstance(entries, dict) else {}


def _read() -> dict[str, Any]:
    with contextlib.suppress(ProcessError):
        content = read_json(list_file())
        return content if isinstance(content, dict) else {}
    return {}


def _note(kind: str, key: str, value: Any) -> None:
    entries = {key: value} | {k: v for k, v in _entries(kind).items() if k != key}
    content = _read() | {kind: dict(list(entries.items())[:MOST])}
    file = list_file()
    new = file.with_name(f"{file.name}.{os.getpid()}")
    # Without a home folder nothing is noted, and `--rig` has to be given.
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        new.write_text(json.dumps(content, indent=1), encoding="utf-8")
        os.replace(new, file)
