"""Cleanup that keeps going: every step runs, the first failure is reported and the others are attached to it."""

import logging
from collections.abc import Callable, Iterable

log = logging.getLogger(__name__)

Step = tuple[str, Callable[[], object]]


def run_all(steps: Iterable[Step]) -> Exception | None:
    """Run every step, also after a failure; return the first failure with notes of the others, or None."""
    first: Exception | None = None
    for name, step in steps:
        try:
            step()
        except Exception as error:  # noqa: BLE001 - a clean-up boundary: no failure may keep the other steps from running
            log.error("clean-up: %s failed: %s", name, error)
            if first is None:
                first = error
                first.add_note(f"while cleaning up: {name}")
            else:
                first.add_note(f"also failed while cleaning up: {name}: {error}")
    return first
