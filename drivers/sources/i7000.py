"""Relay modules of the ICP DAS I-7000 series (I-7060, I-7067) as a light switch that opens without a heartbeat.

DCON protocol, 9600 8N1, ASCII, replies end in CR: ``#AA1cDD`` switches output `c`, ``$AA6`` reads the outputs,
``~**`` is the heartbeat and has no reply, ``~AA3EVV`` sets the host watchdog in tenths of a second, ``~AA0`` reads its
status and ``~AA1`` clears it (I-7000 DIO Manual, sections 2.17 to 2.23; not yet tried on the real box). While the
watchdog has run out the outputs stand at their safe value, which is off as delivered, and each switching command is
answered with ``!`` and ignored.
"""

from typing import Literal

from pydantic import Field

from drivers.errors import CommandRejected, DeviceError, ReplyError, ReplyTimeout, WrongDevice
from drivers.serial_link import LineRegistry, SerialLink, line_framer
from drivers.source import PortSource, SourceConfig

BAUDRATE = 9600


class Config(SourceConfig):
    """Relay module in a rig file."""

    kind: Literal["i7000"] = "i7000"
    address: int = Field(default=1, ge=0, le=255, description="address of the module on its line")
    output: int = Field(default=0, ge=0, le=7, description="relay that lets light pass, counted from 0")
    watchdog_s: float | None = Field(
        default=1.0, ge=0.2, le=25.5, description="the module opens the relay after this time without a heartbeat"
    )


class RelayModule(PortSource):
    """Light passes while the relay is closed."""

    def __init__(self, config: Config, link: SerialLink, lines: LineRegistry) -> None:
        self.config: Config = config
        self._link, self._lines = link, lines
        self._name = f"relay module {config.address:02X} on {config.port}"
        self._model = self._ask("$", "M")
        if not self._model.startswith(("7060", "7067")):
            raise WrongDevice(
                f"identify the {self._name}", f"it answers {self._model!r}", "Correct `source` or `cutoff`"
            )

    def set_light(self, on: bool) -> None:
        """Close or open the relay, read back; closing it starts the watchdog."""
        if on:
            if self.config.watchdog_s is not None:
                self._ask("~", f"31{round(10 * self.config.watchdog_s):02X}")
            self._ask("~", "1")
            self.feed()
        reply = self._exchange("#", f"1{self.config.output}0{int(on)}")
        if reply == "!" and on:
            raise CommandRejected(f"{self._name}, close the relay", "its watchdog has run out", "Look at the line")
        if self.is_on() != on:
            state = "open" if on else "closed"
            raise DeviceError(
                f"{self._name}, {'close' if on else 'open'} the relay", f"it reads as {state}", "Look at it"
            )

    def feed(self) -> None:
        """Send the heartbeat, which has no reply."""
        with self._link.lock:
            self._link.write(b"~**\r")

    def is_on(self) -> bool:
        """True while the relay is closed."""
        reply = self._ask("$", "6", addressed=False)
        try:
            return bool(int(reply[:2], 16) >> self.config.output & 1)
        except ValueError:
            raise self._reply_error("read the outputs", reply) from None

    def _ask(self, lead: str, command: str, *, addressed: bool = True) -> str:
        """The data of a reply ``!AA...``; after an unusable reply the question is repeated once."""
        start = f"!{self.config.address:02X}" if addressed else "!"
        for last in (False, True):
            try:
                reply = self._exchange(lead, command)
                if reply.startswith(start):
                    return reply.removeprefix(start)
                raise self._reply_error(f"{lead}{command}", reply)
            except (ReplyError, ReplyTimeout):
                if last:
                    raise
                self._link.purge()
        raise AssertionError

    def _exchange(self, lead: str, command: str) -> str:
        with self._link.lock:
            self._link.write(f"{lead}{self.config.address:02X}{command}\r".encode("ascii"))
            frame = self._link.read_frame(self._link.clock.now_s() + self.config.reply_s)
        if frame is None:
            request = f"{self._name}, {lead}{command}"
            raise ReplyTimeout(request, f"no reply in {self.config.reply_s:g} s", "Check power, cable and address")
        return frame.decode("ascii", "replace").strip()

    def _reply_error(self, request: str, reply: str) -> ReplyError:
        return ReplyError(f"{self._name}, {request}", f"{reply!r}", "The line is disturbed: check cable and baud rate")


def open(config: Config, lines: LineRegistry) -> RelayModule:
    """Open the module; reads its identity and changes nothing."""
    with lines.link(config, BAUDRATE, line_framer) as link:
        return RelayModule(config, link, lines)
