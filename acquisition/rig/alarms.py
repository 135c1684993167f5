"""Alarms that repeat until they are acknowledged; each is a small file in memory, so that any program sees it."""

import contextlib
import datetime
import errno
import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

#: What to type; every alarm ends with it.
ACKNOWLEDGE = "acquire acknowledge"


@dataclass(frozen=True)
class Alarm:
    """An alarm that is not acknowledged yet."""

    path: Path
    rig: str
    time: str
    text: str


def folder() -> Path:
    """Where the alarms of this user are; /run is memory, and so is most systems' folder for temporary files."""
    for runtime in (os.environ.get("XDG_RUNTIME_DIR"), f"/run/user/{os.getuid()}"):
        if runtime and os.access(runtime, os.W_OK):
            return Path(runtime) / "umov"
    return Path(tempfile.gettempdir()) / f"umov-{os.getuid()}"


def _make_folder() -> Path:
    """The folder, made if it is not there. Raises OSError where another user has made it first."""
    path = folder()
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not _is_own(path):
        raise PermissionError(errno.EPERM, "it belongs to another user", str(path))
    return path


def _is_own(path: Path) -> bool:
    with contextlib.suppress(OSError):
        return path.lstat().st_uid == os.getuid()
    return False


def give_alarm(rig: str, text: str) -> Path:
    """Write an alarm down, or replace the one of this process; it is over when the file is gone. Raises OSError."""
    path = _make_folder() / f"alarm-{os.getpid()}.json"
    now = datetime.datetime.now().astimezone().isoformat(timespec="seconds")
    new = path.with_suffix(".new")
    new.write_text(json.dumps({"rig": rig, "time": now, "text": text}), encoding="utf-8")
    new.rename(path)
    return path


def keep(title: str, name: str, text: str) -> str:
    """Write a text to a file in memory; returns a sentence that says where."""
    try:
        path = _make_folder() / name
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        return f"The {title} could not be kept ({error})."
    return f"The {title} is in {path}."


def unacknowledged() -> list[Alarm]:
    """The alarms that are not acknowledged, the oldest first."""
    pending = []
    for path in folder().glob("alarm-*.json") if _is_own(folder()) else ():
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            content = json.loads(path.read_text(encoding="utf-8"))
            pending.append(Alarm(path, str(content["rig"]), str(content["time"]), str(content["text"])))
    return sorted(pending, key=lambda alarm: alarm.time)


def acknowledge(alarm: Alarm) -> None:
    """Acknowledge an alarm: the guard that repeats it records this and ends."""
    alarm.path.unlink(missing_ok=True)
