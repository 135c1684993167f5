"""A port whose controller takes and answers lines of text, without naming the question in the answer."""

import re
from typing import ClassVar

from drivers.serial_link import ControllerLine
from drivers.unmarked_replies import ask, text_of


class TextLine(ControllerLine):
    """Questions and commands over such a line, with `line_framer`.

    Attributes
    ----------
    controller : its name, for messages.
    end : what ends a command; a single control character has no end.
    what_to_check : for the messages.
    """

    controller: ClassVar[str]
    end: ClassVar[str]
    what_to_check: ClassVar[str] = "Check power, cable and baud rate"

    def _bytes(self, command: str) -> bytes:
        return f"{command}{self.end if command >= ' ' else ''}".encode("ascii")

    def send(self, command: str) -> None:
        """Write a command that answers nothing of interest; takes no lock."""
        self.link.write(self._bytes(command))

    def ask(self, command: str, form: re.Pattern[str]) -> str:
        """Ask a question and return the reply of the given form; once more if none came.

        Raises ReplyTimeout, ReplyError.
        """
        request = f"{self.controller} {self.link.port}, {command if command >= ' ' else repr(command)}"
        question, check = self._bytes(command), self.what_to_check
        return ask(self.link, question, text_of(form), self.reply_s, request=request, what_to_check=check)
