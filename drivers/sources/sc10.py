"""Thorlabs SC10 beam shutter controller: shutter for dark states, interlock input for the door.

Text protocol, 9600 8N1: a command ends in CR; the box echoes it, answers in lines that end in CR and then sends
the prompt "> ". `ens` toggles the enable state, `ens?` reads it, `closed?` reads the blade, `interlock?` is 1 while
the interlock circuit is open (command names as in the public InstrumentKit driver; not yet tried on the real box).
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from drivers.clock import Clock
from drivers.errors import CommandRejected, DeviceError, ReplyError, ReplyTimeout, WrongDevice
from drivers.serial_link import LineRegistry, SerialLink, Transcript
from drivers.source import LightSource

BAUDRATE = 9600
PROMPT = b"> "


class Config(BaseModel):
    """SC10 in a rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["sc10"] = "sc10"
    port: str = Field(description="device path, /dev/serial/by-id path or socket://host:port")
    held_by: str | None = Field(default=None, description="program that may hold the port too: its simulator")
    reply_s: float = Field(default=1.0, gt=0, description="longest wait for a reply")
    blade_s: float = Field(default=1.0, gt=0, description="longest time for the blade to open or close")


def prompt_framer(buffer: bytearray) -> bytes | None:
    """Take everything up to the prompt off the buffer."""
    end = buffer.find(PROMPT)
    if end < 0:
        return None
    frame = bytes(buffer[:end])
    del buffer[: end + len(PROMPT)]
    return frame


class Shutter(LightSource):
    """SC10 in manual mode: light is on while the shutter is enabled."""

    def __init__(self, config: Config, link: SerialLink, lines: LineRegistry) -> None:
        self.config = config
        self._link, self._lines = link, lines
        self._model = self._ask("id?")
        if "SC10" not in self._model.upper():
            raise WrongDevice(
                f"identify the shutter on {config.port}",
                f"it answers {self._model!r}, which is no SC10",
                "Correct `source` in the rig file",
            )

    def set_light(self, on: bool) -> None:
        """Open or close the blade and wait until `closed?` agrees."""
        asked = f"shutter on {self.config.port}, {'open' if on else 'close'}"
        if on and self.interlock_open():
            raise CommandRejected(asked, "its interlock is open", "Close the door or the interlock circuit")
        if self._ask("mode?") != "1":
            self._tell("mode=1")
        # `ens` toggles: it is sent only after a fresh reading and never repeated.
        if self._flag("ens?") != on:
            self._tell("ens")
        deadline_s = self._link.clock.now_s() + self.config.blade_s
        while self._flag("closed?") == on:
            if self._link.clock.now_s() > deadline_s:
                state = "closed" if on else "open"
                raise DeviceError(asked, f"the blade is still {state} after {self.config.blade_s:g} s", "Look at it")
            self._link.clock.sleep_s(0.005)

    def is_on(self) -> bool:
        """True if the blade is open."""
        return not self._flag("closed?")

    def interlock_open(self) -> bool:
        """True if the interlock circuit is open."""
        return self._flag("interlock?")

    def describe(self) -> dict[str, str]:
        """Kind, model and port."""
        return {"kind": "sc10", "model": self._model, "port": self.config.port}

    def close(self) -> None:
        """Give the port back."""
        self._lines.release(self.config.port)

    def _flag(self, query: str) -> bool:
        answer = self._ask(query)
        if not answer.isdigit():
            raise ReplyError(
                f"shutter on {self.config.port}, {query}",
                f"{answer!r} instead of a number",
                "The line is disturbed: check cable and baud rate",
            )
        return answer != "0"

    def _ask(self, query: str) -> str:
        """One query; an unusable reply is asked for once more, after the line has been quiet."""
        try:
            return self._exchange(query)
        except (ReplyError, ReplyTimeout):
            self._link.purge()
            return self._exchange(query)

    def _tell(self, command: str) -> None:
        """One command, sent once: whether it worked is read from the state afterwards."""
        try:
            self._exchange(command)
        except (ReplyError, ReplyTimeout):
            self._link.purge()

    def _exchange(self, text: str) -> str:
        asked = f"shutter on {self.config.port}, {text}"
        with self._link.lock:
            self._link.write(text.encode("ascii") + b"\r")
            frame = self._link.read_frame(self._link.clock.now_s() + self.config.reply_s)
        if frame is None:
            raise ReplyTimeout(asked, f"no reply in {self.config.reply_s:g} s", "Check power, cable and baud rate")
        lines = frame.decode("ascii", "replace").replace("\n", "").split("\r")
        if lines[0] != text:
            raise ReplyError(asked, f"the echo is {lines[0]!r}", "The line is disturbed: check cable and baud rate")
        answer = " ".join(line for line in lines[1:] if line)
        if "error" in answer.lower():
            raise CommandRejected(asked, answer, "Check that it is an SC10 with current firmware")
        return answer


def open(config: Config, lines: LineRegistry) -> Shutter:
    """Open the shutter; sends one `id?` and changes nothing."""
    link = lines.take(config.port, SerialLink, lambda transcript: _link(config, transcript, lines.clock))
    try:
        return Shutter(config, link, lines)
    except BaseException:
        lines.release(config.port)
        raise


def _link(config: Config, transcript: Transcript | None, clock: Clock) -> SerialLink:
    return SerialLink(config.port, BAUDRATE, prompt_framer, transcript=transcript, clock=clock, held_by=config.held_by)
