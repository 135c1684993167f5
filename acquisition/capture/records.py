"""Records of a run: the begin and the end of its segment."""

import getpass
import os
import socket
from dataclasses import asdict
from typing import Any

from acquisition.capture.header import now
from acquisition.capture.identity import identity_of, places
from acquisition.capture.job import Job
from acquisition.capture.runner import CaptureRunner
from acquisition.errors import Unforeseen
from acquisition.rig.rig import Rig


def begin_record(job: Job, rig: Rig, number: int) -> dict[str, Any]:
    """The begin record: program, time and set-up of a segment."""
    return {
        "event": "begin",
        "segment": number,
        "time": now(),
        "by": f"{_user()} on {socket.gethostname()}, process {os.getpid()}",
        "identity": identity_of(job.plan, job.rig, job.instrument, rig).model_dump(),
        "camera_settings": rig.require_camera().settings.model_dump(exclude_none=True),
        "camera_warnings": rig.require_camera().warnings(),
        "places": places(rig.describe()),
    }


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        # A number without a name, as in a container.
        return f"user {os.getuid()}"


def end_record(
    runner: CaptureRunner, rig: Rig, number: int, status: str, *, failure: BaseException | None
) -> dict[str, Any]:
    """What became of the run."""
    record: dict[str, Any] = {
        "event": "end",
        "segment": number,
        "time": now(),
        "status": status,
        "ledger": runner.ledger.summary(),
        "messages": runner.messages.texts,
        "messages_dropped": runner.messages.dropped,
        "interlocks": runner.interlocks.events,
        "evidence": [asdict(finding) for finding in runner.checks.evidence.found],
        "camera_settings": rig.require_camera().settings.model_dump(exclude_none=True),
    }
    if failure is not None:
        record["failure"] = str(failure) or type(failure).__name__
        if isinstance(failure, Unforeseen):
            record["traceback"] = failure.trace
    try:
        record["stream"] = asdict(rig.require_camera().statistics())
    except Exception as error:  # noqa: BLE001 - the record is written whatever the camera does
        record["stream"] = {"failure": str(error)}
    return record
