"""A port whose controller takes lines of text and answers in lines, without saying what they answer."""

import re

from drivers.serial_link import SerialLink
from drivers.unmarked_replies import ask, text_of


class TextLine:
    """Questions and commands over such a line.

    Parameters
    ----------
    link : open, with `line_framer`.
    name : of the controller, for messages.
    reply_s : longest wait for a reply.
    end : what ends a command.
    what_to_check : for the messages.
    """

    def __init__(self, link: SerialLink, name: str, reply_s: float, *, end: str, what_to_check: str) -> None:
        self.link = link
        self._asked = f"{name} {link.port}"
        self._reply_s = reply_s
        self._end = end
        self._check = what_to_check

    def close(self) -> None:
        """Close the port."""
        self.link.close()

    def send(self, command: str) -> None:
        """Write a command that answers nothing of interest; takes no lock."""
        self.link.write(f"{command}{self._end}".encode("ascii"))

    def ask(self, command: str, form: re.Pattern[str]) -> str:
        """Ask a question and return the reply of the given form; once more if none came.

        Raises
        ------
        ReplyTimeout, ReplyError
        """
        asked, question = f"{self._asked}, {command}", f"{command}{self._end}".encode("ascii")
        return ask(self.link, question, text_of(form), self._reply_s, asked=asked, what_to_check=self._check)
