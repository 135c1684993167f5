"""Questions over lines whose replies do not name the question: only order and form identify it."""

import re
from collections.abc import Callable
from typing import TypeVar

from drivers.errors import ReplyError, ReplyTimeout
from drivers.serial_link import SerialLink

T = TypeVar("T")


def ask(
    link: SerialLink,
    question: bytes,
    read: Callable[[bytes], T | None],
    reply_s: float,
    *,
    request: str,
    what_to_check: str,
    tries: int = 2,
) -> T:
    """Ask a question and return the value of the first reply to it; again if none came.

    Parameters
    ----------
    question : bytes to write.
    read : gets each frame and returns its value, or None if it is no reply to this question.
    reply_s : longest wait, for each of the tries.
    request, what_to_check : for the messages.

    Raises
    ------
    ReplyTimeout, ReplyError
    """
    frames: list[bytes] = []
    for _ in range(tries):
        with link.lock:
            # What waits here was not asked for now.
            link.purge(0.0)
            link.write(question)
            deadline_s = link.clock.now_s() + reply_s
            while (frame := link.read_frame(deadline_s)) is not None:
                if (reply := read(frame)) is not None:
                    return reply
                frames.append(frame)
            link.purge()
    if frames:
        raise ReplyError(request, f"no valid reply, but {frames[:3]}", what_to_check)
    raise ReplyTimeout(request, f"nothing within {reply_s} s", what_to_check)


def text_of(form: re.Pattern[str]) -> Callable[[bytes], str | None]:
    """Read a line of text that has a form as a whole."""

    def read(frame: bytes) -> str | None:
        text = frame.decode("ascii", "replace").strip()
        return text if form.fullmatch(text) else None

    return read
