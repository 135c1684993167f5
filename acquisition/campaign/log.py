"""Log (JSON lines) and index of the captures of a campaign."""

import datetime
import json
import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import filelock
import numpy as np

from acquisition.campaign.identity import IDENTITY
from acquisition.campaign.plan import Campaign, CampaignCapture
from acquisition.capture.state_file import KILLED_S
from acquisition.capture.synced import make_folder, sync
from acquisition.disc import hold, let_go, on_disc
from acquisition.errors import AcquisitionError
from processing.doors import read_json, read_text
from processing.errors import ProcessError
from processing.storage.captures.capture import Capture
from processing.whole_file import make_plain, open_plain
from processing.yaml_file import ConfigError, dump_yaml, load_yaml

log = logging.getLogger(__name__)

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
        make_folder(folder)
        hold(folder, _lock)
        try:
            self._require_same(campaign)
            self.index = read_index(folder)
        except BaseException:
            self.close()
            raise

    def _require_same(self, campaign: Campaign) -> None:
        plan, text = self.folder / PLAN, dump_yaml(campaign)
        if not plan.exists():
            self._write_whole(plan, text)
        elif read_text(plan, ConfigError) != text:
            # A folder that is no longer a campaign raises its own error.
            load_yaml(plan, Campaign)
            raise AcquisitionError(
                f"{self.folder} holds another campaign: {plan} differs from the file given. "
                "Give the same file, or another folder with --out."
            )

    def begin_with(self, identity: Mapping[str, Any]) -> None:
        """Write the identity of the campaign, once."""
        if not (self.folder / IDENTITY).exists():
            self._write_whole(self.folder / IDENTITY, json.dumps(identity, indent=1))

    def log(self, event: str, **details: Any) -> None:
        """Add a line to the log; it is on the disc when this returns."""
        line = {"time": datetime.datetime.now().astimezone().isoformat(timespec="milliseconds"), "event": event}
        path = self.folder / LOG
        with self._room_for(path):
            on_disc(f"write {path}", _append, path, json.dumps(line | details, default=str) + "\n")

    def record(self, capture: str, **details: Any) -> None:
        """Write what became of a capture into the index, which is whole at any instant."""
        self.index[capture] = self.index.get(capture, {}) | details
        self._write_whole(self.folder / INDEX, json.dumps(self.index, indent=1, default=str))

    def _write_whole(self, path: Path, text: str) -> None:
        with self._room_for(path):
            on_disc(f"write {path}", _replace, path, text)

    @contextmanager
    def _room_for(self, path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise AcquisitionError(
                f"{path} cannot be written ({error.strerror}). The captures taken so far are whole. Make room, then "
                "the same command goes on."
            ) from error

    def close(self) -> None:
        """Let another program run the campaign."""
        with suppress(AcquisitionError):
            let_go(self.folder, _unlock)


#: Locks of the folders that are held, in the disc process.
_held: dict[Path, filelock.BaseFileLock] = {}


def _lock(folder: Path) -> None:
    path = folder / ".lock"
    lock = filelock.FileLock(path)
    try:
        # Some versions of the library empty what they lock.
        make_plain(path)
        lock.acquire(timeout=KILLED_S)
    except filelock.Timeout:
        raise AcquisitionError(f"another program runs the campaign in {folder}. End that one first.") from None
    except OSError as error:
        raise AcquisitionError(f"{path} cannot be written ({error.strerror}). Remove it, or make room.") from error
    _held[folder] = lock


def _unlock(folder: Path) -> None:
    if (lock := _held.pop(folder, None)) is not None:
        lock.release()


def _append(path: Path, text: str) -> None:
    with open(open_plain(path, os.O_RDWR | os.O_APPEND), "ab+") as file:
        # A line that was cut off by a full disc must not spoil the next.
        end = file.seek(0, os.SEEK_END)
        cut_off = end and file.seek(end - 1) is not None and file.read(1) != b"\n"
        file.write(("\n" * bool(cut_off) + text).encode())
        file.flush()
        os.fsync(file.fileno())


def _replace(path: Path, text: str) -> None:
    new = path.with_name(path.name + ".new")
    with open(open_plain(new, os.O_WRONLY), "w", encoding="utf-8") as file:
        file.truncate(0)
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(new, path)
    sync(path.parent)


def read_index(folder: Path) -> dict[str, dict[str, Any]]:
    """The index of a campaign, empty where there is none or it is damaged: a run writes what it finds into it anew."""
    path = folder / INDEX
    if not path.exists():
        return {}
    try:
        index = read_json(path)
        if isinstance(index, dict) and all(isinstance(entry, dict) for entry in index.values()):
            return index
    except ProcessError as error:
        log.warning("%s", error)
    log.warning("%s is damaged: it is rebuilt from the captures", path)
    return {}


def entry_of(capture: CampaignCapture, path: Path) -> dict[str, Any]:
    """The index entry of a capture file. Raises CaptureError."""
    plan = capture.plan
    with Capture(path) as file:
        saturated = float(np.max(file.column("saturated_fraction"), initial=0.0))
        status, states = file.status, len(file.done)
    return {
        "status": status, "states": states, "file": path.name, "reference": capture.reference, "role": plan.role,
        "omega_deg": plan.omega_deg, "wavelength_nm": plan.wavelength_nm, "mode": plan.mode, "sample": plan.sample.name,
        "saturated_fraction": saturated, "error": None,
    }  # fmt: skip
