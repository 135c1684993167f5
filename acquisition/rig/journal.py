"""The journal of the guard: lines of JSON, written by another process."""

import datetime
import json
from pathlib import Path
from typing import Any

from drivers.log_process import LogProcess


class Journal:
    """A log in JSON lines, appended to its file, if it has one."""

    def __init__(self, path: Path | None) -> None:
        self._log = LogProcess(path)
        self.flush = self._log.flush

    def note(self, event: str, **details: Any) -> None:
        """Add a line; a log that cannot be written holds up nothing."""
        when = datetime.datetime.now().astimezone().isoformat(timespec="milliseconds")
        self._log.add(json.dumps({"time": when, "event": event} | details) + "\n")

    def close(self) -> None:
        """Write the pending notes, as far as the disc takes them."""
        self._log.close()
