"""Text protocol of Thorlabs' small boxes: a command ends in CR; the box echoes it, answers in lines that end in CR, and
then sends the prompt ">", which the SC10 and the FW102C follow with a blank."""

from __future__ import annotations

import re

from drivers.errors import CommandRejected, ReplyError, ReplyTimeout
from drivers.serial_link import SerialLink

PROMPT = b">"


def prompt_framer(buffer: bytearray) -> bytes | None:
    """Take everything up to the prompt off the buffer."""
    end = buffer.find(PROMPT)
    if end < 0:
        return None
    frame = bytes(buffer[:end])
    del buffer[: end + len(PROMPT)]
    return frame


class PromptLine:
    """Questions and commands over such a line.

    Parameters
    ----------
    link : open, with `prompt_framer`.
    name : of the device, for messages.
    reply_s : longest wait for an answer.
    """

    def __init__(self, link: SerialLink, name: str, reply_s: float) -> None:
        self._link = link
        self._name = name
        self._reply_s = reply_s

    def ask(self, query: str) -> str:
        """One query; an unusable reply is asked for once more, after the line has been quiet.

        Raises
        ------
        CommandRejected, ReplyError, ReplyTimeout
        """
        try:
            return self._exchange(query, self._reply_s)
        except (ReplyError, ReplyTimeout):
            self._link.purge()
            return self._exchange(query, self._reply_s)

    def tell(self, command: str, reply_s: float | None = None) -> None:
        """One command, sent once: whether it worked is read from the state afterwards. Raises CommandRejected."""
        try:
            self._exchange(command, reply_s or self._reply_s)
        except (ReplyError, ReplyTimeout):
            self._link.purge()

    def ask_number(self, query: str) -> int:
        """The answer to a query that is answered with a number; raises as `ask`."""
        answer = self.ask(query)
        if not answer.isdigit():
            raise ReplyError(
                f"{self._name}, {query}",
                f"{answer!r} instead of a number",
                "The line is disturbed: check cable and baud rate",
            )
        return int(answer)

    def _exchange(self, text: str, reply_s: float) -> str:
        asked = f"{self._name}, {text}"
        with self._link.lock:
            self._link.write(text.encode("ascii") + b"\r")
            frame = self._link.read_frame(self._link.clock.now_s() + reply_s)
        if frame is None:
            raise ReplyTimeout(asked, f"no reply in {reply_s:g} s", "Check power, cable and baud rate")
        # The blank behind the prompt of the answer before stands at the front.
        # Terminal servers turn the CR of the box into LF, or into both.
        lines = re.split(r"[\r\n]+", frame.decode("ascii", "replace").lstrip(" \r\n"))
        if lines[0] != text:
            raise ReplyError(asked, f"the echo is {lines[0]!r}", "The line is disturbed: check cable and baud rate")
        answer = " ".join(line for line in lines[1:] if line)
        if "error" in answer.lower():
            raise CommandRejected(asked, answer, "Check the device's model and firmware")
        return answer
