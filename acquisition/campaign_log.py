"""What a campaign leaves behind besides captures: a log in JSON lines, and an index of what was taken."""

from __future__ import annotations

import datetime
import json
import os
from pathlib import Path
from typing import Any

import filelock

from acquisition.campaign import Campaign
from acquisition.errors import AcquisitionError
from processing.yaml_file import dump_yaml

LOG = "log.jsonl"
INDEX = "index.json"
PLAN = "campaign.yaml"


class CampaignFolder:
    """The folder of one campaign, held by one program at a time.

    Raises
    ------
    AcquisitionError
        The folder belongs to another campaign, or another program runs this one.
    """

    def __init__(self, folder: Path, campaign: Campaign) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self._lock = filelock.FileLock(folder / ".lock")
        try:
            self._lock.acquire(timeout=0)
        except filelock.Timeout:
            raise AcquisitionError(f"another program runs the campaign in {folder}. End that one first.") from None
        text = dump_yaml(campaign)
        plan = folder / PLAN
        if plan.exists() and plan.read_text(encoding="utf-8") != text:
            self.close()
            raise AcquisitionError(
                f"{folder} holds another campaign: {plan} differs from the file given. "
                "Give the same file, or another folder with --out."
            )
        plan.write_text(text, encoding="utf-8")
        self.index: dict[str, dict[str, Any]] = {}
        if (folder / INDEX).exists():
            self.index = json.loads((folder / INDEX).read_text(encoding="utf-8"))

    def log(self, event: str, **details: Any) -> None:
        """Add a line to the log; it is on the disc when this returns."""
        line = {"time": datetime.datetime.now().astimezone().isoformat(timespec="milliseconds"), "event": event}
        with (self.folder / LOG).open("a", encoding="utf-8") as file:
            file.write(json.dumps(line | details, default=str) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def record(self, capture: str, **details: Any) -> None:
        """Write what became of a capture into the index, which is whole at any instant."""
        self.index[capture] = self.index.get(capture, {}) | details
        new = self.folder / (INDEX + ".new")
        with new.open("w", encoding="utf-8") as file:
            json.dump(self.index, file, indent=1, default=str)
            file.flush()
            os.fsync(file.fileno())
        os.replace(new, self.folder / INDEX)

    def close(self) -> None:
        """Let another program run the campaign."""
        self._lock.release()
