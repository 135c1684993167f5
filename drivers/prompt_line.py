"""Text protocol of Thorlabs' small boxes: a command ends in CR; most boxes echo it; all answer in lines that end in CR,
and then send the prompt ">", which the SC10 and the FW102C follow with a blank."""

import re

from drivers.errors import CommandRejected, ReplyError, ReplyTimeout
from drivers.serial_link import SerialLink, framer_of

prompt_framer = framer_of(b">")


class PromptLine:
    """Questions and commands over such a line.

    Parameters
    ----------
    link : open, with `prompt_framer`.
    name : of the device, for messages.
    reply_s : longest wait for an answer.
    echo : whether the box repeats a command before it answers.
    """

    def __init__(self, link: SerialLink, name: str, reply_s: float, *, echo: bool = True) -> None:
        self._link = link
        self._name = name
        self._reply_s = reply_s
        self._echo = echo

    def ask(self, query: str, form: re.Pattern[str] | None = None) -> str:
        """One query; after an unusable reply, also one of another form, it is repeated once after a pause.

        Raises CommandRejected, ReplyError, ReplyTimeout.
        """
        try:
            return self._exchange(query, self._reply_s, form)
        except (ReplyError, ReplyTimeout):
            self._link.purge()
            return self._exchange(query, self._reply_s, form)

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

    def _exchange(self, text: str, reply_s: float, form: re.Pattern[str] | None = None) -> str:
        request = f"{self._name}, {text}"
        with self._link.lock:
            # What waits here was not asked for now.
            self._link.purge(0.0)
            self._link.write(text.encode("ascii") + b"\r")
            frame = self._link.read_frame(self._link.clock.now_s() + reply_s)
        if frame is None:
            raise ReplyTimeout(request, f"no reply in {reply_s:g} s", "Check power, cable and baud rate")
        # The blank behind the prompt of the answer before stands at the front.
        # Terminal servers turn the CR of the box into LF, or into both.
        lines = re.split(r"[\r\n]+", frame.decode("ascii", "replace").lstrip(" \r\n"))
        check = "The line is disturbed: check cable and baud rate"
        if self._echo and lines.pop(0) != text:
            raise ReplyError(request, f"the echo of {text!r} is missing in {frame!r}", check)
        answer = " ".join(line for line in lines if line)
        if "error" in answer.lower() or answer.startswith("CMD_"):
            raise CommandRejected(request, answer, "Check the device's model and firmware")
        if form is not None and not form.fullmatch(answer):
            raise ReplyError(request, f"{answer!r} is no answer to it", check)
        return answer
