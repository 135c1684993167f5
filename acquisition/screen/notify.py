"""Notifications of the end of a run, a failure, or an open interlock: by a command, a webhook, or both."""

import json
import logging
import os
import subprocess
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from acquisition.errors import as_run_error
from acquisition.screen.observer import Observer
from processing.section import Section

log = logging.getLogger(__name__)

Event = Literal["end", "failure", "interlock"]
#: How long a command or a web server may take, and how long the end of the program waits for it, seconds.
PATIENCE_S = 10.0


class NotifyConfig(Section):
    """Section `notify` of a rig file: who hears of what."""

    command: tuple[str, ...] = Field(
        default=(), description="command that is run with the message as its last argument and JSON on standard input"
    )
    webhook: str | None = Field(
        default=None, pattern=r"^https?://", description="address that the same JSON is posted to"
    )
    on: tuple[Event, ...] = Field(default=("end", "failure", "interlock"), description="what is told")


class Notifier(Observer):
    """Sends messages from threads of its own: nobody waits for them but the end of the program, for a while.

    Parameters
    ----------
    subject : name of the capture file or of the campaign.
    """

    def __init__(self, config: NotifyConfig | None, subject: Path, simulated: bool) -> None:
        self._config = config
        self._facts: dict[str, Any] = {"what": str(subject), "simulated": simulated}
        self._sending: list[threading.Thread] = []

    def warning(self, text: str) -> None:
        if text.startswith("interlock"):
            self.tell("interlock", text)

    def tell(self, event: Event, text: str, **details: Any) -> None:
        """Send a message, if the rig file asks for this event; never raises."""
        if self._config is None or event not in self._config.on:
            return
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        message = {"event": event, "text": text, "time": now, **self._facts, **details}
        for send in (self._run, self._post):
            thread = threading.Thread(target=send, args=(self._config, message), name="notify", daemon=True)
            self._sending.append(thread)
            thread.start()

    def _run(self, config: NotifyConfig, message: Mapping[str, Any]) -> None:
        if not config.command:
            return
        words = f"{'SIMULATED ' if message['simulated'] else ''}{message['event']}: {message['text']}"
        try:
            done = subprocess.run(
                [*config.command, words], input=json.dumps(message).encode(), capture_output=True, timeout=PATIENCE_S
            )
            if done.returncode:
                log.warning("notify: %s ended with %d", config.command[0], done.returncode)
        except (OSError, subprocess.SubprocessError) as error:
            log.warning("notify: %s cannot be run (%s)", config.command[0], error)

    def _post(self, config: NotifyConfig, message: Mapping[str, Any]) -> None:
        if config.webhook is None:
            return
        import urllib.request

        content = json.dumps(message).encode()
        request = urllib.request.Request(config.webhook, content, {"Content-Type": "application/json"})
        try:
            urllib.request.urlopen(request, timeout=PATIENCE_S).close()
        except (OSError, ValueError) as error:
            log.warning("notify: %s cannot be reached (%s)", config.webhook, error)

    def settle(self) -> None:
        """Wait a short time until the messages are sent."""
        for thread in self._sending:
            thread.join(PATIENCE_S)


@contextmanager
def notifying(config: NotifyConfig | None, subject: Path, simulated: bool) -> Iterator[Notifier]:
    """A notifier around a run: an error of the run is sent as a failure, and raised again."""
    notifier = Notifier(config, subject, simulated)
    try:
        yield notifier
    except Exception as error:
        notifier.tell("failure", str(as_run_error(error)), pid=os.getpid())
        raise
    finally:
        notifier.settle()
