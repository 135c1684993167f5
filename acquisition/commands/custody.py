"""`acquire verify`, `repair` and `compress`: complete, damaged and incomplete captures of a folder."""

from collections.abc import Iterator
from pathlib import Path

from acquisition.campaign.log import INDEX, PLAN, CampaignFolder, entry_of, read_index
from acquisition.campaign.plan import Campaign, CampaignCapture, captures
from acquisition.capture.partial_file import NEW, PARTIAL, mark_not_taken, seal_whole
from acquisition.commands.doctor import Finding
from acquisition.errors import AcquisitionError
from processing.errors import ProcessError
from processing.storage.captures.capture import Capture, CaptureError, made_of_captures
from processing.storage.captures.packed_capture import pack_capture
from processing.storage.integrity.h5_door import mark_of
from processing.yaml_file import load_yaml


def verify(folder: Path) -> Iterator[Finding]:
    """Read every frame of every capture in a folder, and list stray files; changes nothing.

    A finding is not well where something is damaged or contradicts the index, None where something is unfinished.
    """
    for path in sorted(folder.iterdir()):
        if path.name.endswith(NEW):
            yield Finding(
                path.name, None, "remains of a program that was killed while it wrote a file; repair removes it"
            )
        elif _is_capture(path):
            yield _capture(path)
    if (folder / PLAN).exists():
        yield from _index(folder)


def _is_capture(path: Path) -> bool:
    """Whether a file is named like a capture and is nothing else."""
    return path.name.endswith((".h5", PARTIAL)) and not made_of_captures(path)


def _capture(path: Path) -> Finding:
    try:
        with Capture(path, verify=False) as capture:
            damaged = capture.damaged_states()
            done, planned, status = len(capture.done), capture.planned_states, capture.status
            summed, runs = capture.checked or done == 0, len(capture.segments)
    except CaptureError as error:
        return Finding(path.name, False, str(error))
    if damaged:
        states = ", ".join(map(str, damaged))
        return Finding(path.name, False, f"DAMAGED: state {states}; repair marks it as not taken, then --resume")
    text = f"{done} of {planned} states, {status}"
    text += f", {runs} runs" if runs > 1 else ""
    text += "" if summed else "; without checksums, so a change on the disc would not show"
    if path.name.endswith(PARTIAL):
        text += "; repair seals it" if done == planned else "; continue with acquire --resume"
    return Finding(path.name, True if status == "complete" and not path.name.endswith(PARTIAL) else None, text)


def _load_captures(folder: Path) -> list[CampaignCapture]:
    return list(captures(load_yaml(folder / PLAN, Campaign)))


def _index(folder: Path) -> Iterator[Finding]:
    try:
        campaign = _load_captures(folder)
    except ProcessError as error:
        yield Finding(PLAN, False, str(error))
        return
    index = read_index(folder)
    names = {capture.name for capture in campaign}
    stale = []
    for capture in campaign:
        path = folder / capture.name
        entry = index.get(capture.name, {})
        try:
            stale += [capture.name] if path.exists() and entry_of(capture, path) != entry else []
        except CaptureError:
            # Named above.
            continue
        if entry.get("status") == "complete" and not path.exists():
            yield Finding(capture.name, False, f"{INDEX} has it as complete, but the file is not there")
    for path in sorted(folder.glob("*.h5*")):
        if path.name.removesuffix(NEW).removesuffix(PARTIAL) not in names and (
            path.name.endswith(NEW) or _is_capture(path)
        ):
            yield Finding(path.name, None, "is no capture of this campaign")
    yield Finding(INDEX, not stale, "as the files are" if not stale else f"differs for {', '.join(stale)}; repair")


def repair(folder: Path) -> Iterator[Finding]:
    """Finish interrupted work: seal whole captures, remove strays, make the index of a campaign from its files.

    No state is removed. A damaged one is marked as not taken, and its capture is partial again; a file that is no
    capture any more is named and left as it is. Raises AcquisitionError: another program runs the campaign in the
    folder.
    """
    campaign = load_yaml(folder / PLAN, Campaign) if (folder / PLAN).exists() else None
    books = CampaignFolder(folder, campaign) if campaign is not None else None
    try:
        for path in sorted(folder.iterdir()):
            if path.name.endswith(NEW):
                path.unlink()
                yield Finding(path.name, True, "removed")
            elif _is_capture(path):
                yield _repair_capture(path)
        if books is not None:
            yield from _rebuild_index(books)
    finally:
        if books is not None:
            books.close()


def compressed(folder: Path) -> Iterator[Finding]:
    """Compress each complete capture of a folder; incomplete and damaged ones stay as they are."""
    for path in sorted(folder.glob("*.h5")):
        if mark_of(path, "umov_schema") is None:
            continue
        try:
            sizes = pack_capture(path)
        except CaptureError as error:
            yield Finding(path.name, None, str(error))
            continue
        detail = "compressed already" if sizes is None else f"{sizes[0] / 1e6:.1f} MB, now {sizes[1] / 1e6:.1f} MB"
        yield Finding(path.name, True, detail)


def _repair_capture(path: Path) -> Finding:
    try:
        with Capture(path, verify=False) as capture:
            damaged, summed = capture.damaged_states(), capture.checked
        if damaged:
            partial = mark_not_taken(path, damaged)
            return Finding(path.name, None, f"state {', '.join(map(str, damaged))} marked as not taken; {partial.name}")
        if not path.name.endswith(PARTIAL):
            return Finding(path.name, True, "whole" if summed else "complete; the file has no checksums to verify")
        final = seal_whole(path)
    except (CaptureError, AcquisitionError) as error:
        return Finding(path.name, False, str(error))
    if final is None:
        return Finding(path.name, None, "states are missing; continue with acquire --resume")
    return Finding(path.name, True, f"sealed as {final.name}")


def _rebuild_index(held: CampaignFolder) -> Iterator[Finding]:
    for capture in _load_captures(held.folder):
        path = held.folder / capture.name
        try:
            if path.exists():
                held.record(capture.name, **entry_of(capture, path))
            elif held.index.get(capture.name, {}).get("status") == "complete":
                held.record(capture.name, status="missing", error="the file is not there")
        except CaptureError as error:
            held.record(capture.name, status="damaged", error=str(error))
            yield Finding(path.name, False, str(error))
    held.log("index made from the files")
    yield Finding(INDEX, True, f"made from the files: {len(held.index)} captures")
