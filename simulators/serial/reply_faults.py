"""Faults of an emulated controller on a schedule: what goes wrong, from which command or time on, for how long."""

import random
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

FaultKind = Literal["silent", "stuck", "slow", "garbled", "late", "foreign", "not_homed", "slip", "jammed"]

# Default of `amount`: speed factor, delay in real seconds, degrees.
DEFAULT_AMOUNT = {"slow": 0.1, "late": 0.5, "slip": 2.0}


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes
    ----------
    kind : ``silent`` no reply; ``stuck`` the axes stand still while they report a motion; ``slow`` axes at `amount`
        times their speed; ``garbled`` one byte of the reply changed; ``late`` the reply comes `amount` real seconds
        late; ``foreign`` a reply of another device or request comes instead; ``not_homed`` the axes lose their
        reference, once; ``slip`` the optics turn by `amount` degrees against their encoders, once; ``jammed`` a
        shutter's blade stays where it is and its sensor agrees with what was asked (``stuck``: with the blade).
    from_command : first command affected; the emulator counts commands from 1.
    from_s : simulated time before which nothing happens.
    commands : number of commands affected; None for all that follow.
    amount : see `kind`.
    """

    kind: FaultKind
    from_command: int = 1
    from_s: float = 0.0
    commands: int | None = None
    amount: float | None = None

    def size(self) -> float:
        """Return `amount` or its default for this kind."""
        return DEFAULT_AMOUNT.get(self.kind, 0.0) if self.amount is None else self.amount


_SPEC = re.compile(r"(?P<kind>\w+)(?:@(?P<at>\d+(?:\.\d+)?)(?P<unit>s?))?(?:x(?P<count>\d+))?(?::(?P<amount>[\d.]+))?")


def parse_fault(text: str) -> Fault:
    """Read ``KIND[@COMMAND|@TIMEs][xCOUNT][:AMOUNT]``, such as ``garbled@12x1`` or ``slow@3.5s:0.2``.

    Raises ValueError: the text has another form or names an unknown kind.
    """
    match = _SPEC.fullmatch(text)
    if match is None or match["kind"] not in get_args(FaultKind):
        kinds = ", ".join(get_args(FaultKind))
        raise ValueError(f"fault {text!r}: expected KIND[@COMMAND|@TIMEs][xCOUNT][:AMOUNT], KIND one of {kinds}")
    timed = match["unit"] == "s"
    return Fault(
        kind=match["kind"],  # type: ignore[arg-type]
        from_command=1 if timed or match["at"] is None else int(float(match["at"])),
        from_s=float(match["at"]) if timed else 0.0,
        commands=None if match["count"] is None else int(match["count"]),
        amount=None if match["amount"] is None else float(match["amount"]),
    )


class FaultSchedule:
    """The faults of one emulator; the same seed changes the same bytes."""

    def __init__(self, faults: Iterable[Fault] = (), seed: int = 0) -> None:
        self._waiting = list(faults)
        self._remaining: dict[int, int] = {}
        self._random = random.Random(seed)
        self.commands = 0
        self.active: dict[FaultKind, Fault] = {}

    def add(self, *faults: Fault) -> None:
        """Add faults while the emulator runs; their `from_command` counts from now."""
        now = self.commands
        self._waiting += [
            Fault(fault.kind, now + fault.from_command, fault.from_s, fault.commands, fault.amount) for fault in faults
        ]

    def clear(self) -> None:
        """End all faults."""
        self._waiting.clear()
        self.active = {}

    def count_command(self, now_s: float) -> dict[FaultKind, Fault]:
        """Count a command and return the faults that act on it, by kind."""
        self.commands += 1
        self.active = {}
        for fault in list(self._waiting):
            if self.commands < fault.from_command or now_s < fault.from_s:
                continue
            self.active[fault.kind] = fault
            if fault.kind in ("not_homed", "slip"):
                self._waiting.remove(fault)
            elif fault.commands is not None:
                remaining = self._remaining.get(id(fault), fault.commands) - 1
                self._remaining[id(fault)] = remaining
                if remaining <= 0:
                    self._waiting.remove(fault)
        return self.active

    def garble(self, reply: bytes) -> bytes:
        """Change one byte of a reply to another one."""
        if not reply:
            return reply
        index = self._random.randrange(len(reply))
        changed = reply[index] ^ self._random.randrange(1, 256)
        return reply[:index] + bytes([changed]) + reply[index + 1 :]
