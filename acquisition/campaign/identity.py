"""Identity of a campaign: each of its runs has the same rig, plans, instruments, devices and program."""

import json
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from acquisition.campaign.plan import Campaign, CampaignCapture
from acquisition.capture.identity import device_properties, differences, files_of, plain, rig_content
from acquisition.capture.job import Job
from acquisition.errors import Differs
from acquisition.rig.config import RigConfig
from acquisition.rig.rig import Rig
from processing.doors import read_json
from processing.errors import ProcessError

IDENTITY = "identity.json"
#: Parts of the identity that are stored by name.
KINDS = ("rig", "plan", "instrument")
#: Differences that are listed one by one.
SHOWN = 20


def campaign_identity(
    campaign: Campaign, jobs: Sequence[tuple[CampaignCapture, Job]], config: RigConfig, rig_file: Path
) -> dict[str, Any]:
    """The identity of a campaign as plain values; `with_devices` adds the devices.

    Parameters
    ----------
    rig_file : path of the rig file, for the message about a changed set-up.
    """
    modes = {capture.plan.mode: job.instrument for capture, job in jobs}
    facts = {
        "rig_file": str(rig_file),
        "simulated": config.simulated,
        "program": f"umov {version('umov')}",
        "campaign": plain(campaign),
        "rig": {mode: rig_content(config, mode) for mode in modes},
        "files": {key: text for mode in modes for key, text in files_of(config, mode).items()},
        "instrument": {mode: plain(instrument) for mode, instrument in modes.items()},
        "plan": {capture.name: plain(capture.plan) for capture, _ in jobs},
    }
    plain_facts: dict[str, Any] = json.loads(json.dumps(facts))
    return plain_facts


def with_devices(identity: dict[str, Any], rig: Rig) -> dict[str, Any]:
    """The same with the devices of the rig, which is open."""
    return {**identity, "device": device_properties(rig.describe())}


def require_same_campaign(folder: Path, now: dict[str, Any]) -> None:
    """Refuse to continue a campaign that was begun with another set-up.

    Raises Differs with every difference in words, each once.
    """
    then = read_identity(folder)
    if then is None:
        return
    changes = list(dict.fromkeys(_changes(then, now)))
    if changes:
        started = f"it was started with --rig {then.get('rig_file')}"
        raise Differs(
            str(folder), [*changes[:20], *([f"and {len(changes) - 20} more"] if len(changes) > 20 else []), started]
        )


def _changes(then: dict[str, Any], now: dict[str, Any]) -> Iterator[str]:
    for key in now:
        if key not in then and key == "device":
            continue
        if key in KINDS:
            # A difference that several modes or captures share is listed once.
            for name in now[key]:
                yield from differences(then.get(key, {}).get(name), now[key][name], key)
        elif key != "rig_file":
            yield from differences(then.get(key), now[key], key)


def read_identity(folder: Path) -> dict[str, Any] | None:
    """Identity with which the campaign in a folder was begun; None if it has not begun. Raises ProcessError."""
    path = folder / IDENTITY
    if not path.exists():
        return None
    facts = read_json(path)
    if not isinstance(facts, dict) or not all(isinstance(facts.get(key, {}), dict) for key in KINDS):
        raise ProcessError(f"{path} does not say what the campaign was begun with; take it from a copy.")
    return facts


def folder_for(base: Path, now: dict[str, Any], as_new: bool) -> Path:
    """The folder to take a campaign into: `base`, or with `as_new` the first of base, base-2, ... that it may go on in.

    Raises Differs: `base` was begun with something else.
    """
    folder, number = base, 1
    while True:
        try:
            require_same_campaign(folder, now)
            if not as_new or read_identity(folder) is not None or not folder.exists():
                return folder
        except Differs:
            if not as_new:
                raise
        number += 1
        folder = base.with_name(f"{base.name}-{number}")
