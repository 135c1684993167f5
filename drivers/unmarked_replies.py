"""Questions over lines whose replies carry neither address nor question: only order and form tell whose they are."""

from __future__ import annotations

import re

from drivers.errors import ReplyError, ReplyTimeout
from drivers.serial_link import SerialLink


def ask(
    link: SerialLink, question: bytes, form: re.Pattern[str], reply_s: float, asked: str, what_to_check: str
) -> str:
    """Ask a question and return the first reply of the given form; once more if none came.

    Parameters
    ----------
    question : bytes to write.
    form : what the whole reply looks like, without its line end.
    reply_s : longest wait, for each of the two tries.
    asked, what_to_check : for the messages.

    Raises
    ------
    ReplyTimeout, ReplyError
    """
    seen: list[bytes] = []
    for _ in range(2):
        with link.lock:
            # What waits here was not asked for now.
            link.purge(0.0)
            link.write(question)
            deadline_s = link.clock.now_s() + reply_s
            while (frame := link.read_frame(deadline_s)) is not None:
                text = frame.decode("ascii", "replace").strip()
                if form.fullmatch(text):
                    return text
                seen.append(frame)
            link.purge()
    if seen:
        raise ReplyError(asked, f"no valid reply, but {seen[:3]}", "Check cable and baud rate")
    raise ReplyTimeout(asked, f"nothing within {reply_s} s", what_to_check)
