"""Thorlabs DC4100 on the wire, line by line as Micro-Manager's adapter sends it."""

import pytest

from drivers.errors import CommandRejected
from drivers.serial_link import LineRegistry
from drivers.sources import dc4100
from simulators.clock import patient_clock
from tests.protocol.scripted import scripted

# Status 0xA80: no LED at channels 2, 3 and 4, so one LED is driven.
OPENING = [
    *[(b"N?\r\n", b"DC4100\r\n")] * 2,
    *[(b"S?\r\n", b"M00223344\r\n")] * 2,
    *[(b"V?\r\n", b"1.4.0\r\n")] * 2,
    *[(b"R?\r\n", b"2688\r\n")] * 2,
    *[(b"WL? 0\r\n", b"660.0\r\n")] * 2,
    *[(b"O? 0\r\n", b"0\r\n")] * 2,
]
# There is no checksum, so constants and what decides about light are asked twice.
OFF, ON = [("O? 0", "0")] * 2, [("O? 0", "1")] * 2


def wire(pairs: list[tuple[str, str]]) -> list[tuple[bytes, bytes]]:
    return [
        *OPENING,
        *((f"{sent}\r\n".encode(), f"{answer}\r\n".encode() if answer else b"") for sent, answer in pairs),
    ]


def opened(path: str, lines: LineRegistry) -> dc4100.Dc4100:
    return dc4100.open(dc4100.Config(port=path), lines)


@pytest.mark.parametrize(
    ("action", "pairs"),
    [
        (lambda source: source.set_light(True), [*OFF, ("O 0 1", ""), *ON]),
        (lambda source: source.set_light(True), ON),
        (lambda source: source.set_light(False), [*ON, ("O 0 0", ""), *OFF]),
        (lambda source: source.is_on(), ON),
        (
            lambda source: (source.select(662.0), source.set_level(40.0)),
            [*OFF, *[("M?", "1")] * 2, ("BP 0 40", ""), *[("BP? 0", "40.0")] * 2],
        ),
        (
            lambda source: (source.select(662.0), source.set_level(12.5)),
            [
                *OFF,
                *[("M?", "0")] * 2,
                *OFF,
                ("M 1", ""),
                *[("M?", "1")] * 2,
                ("BP 0 12.5", ""),
                *[("BP? 0", "13")] * 2,
            ],
        ),
    ],
)
def test_each_call_sends_these_lines_and_no_others(action, pairs) -> None:  # type: ignore[no-untyped-def]
    with scripted(*wire(pairs)) as path, LineRegistry(clock=patient_clock()) as lines:
        action(opened(path, lines))


def test_a_refusal_is_explained_by_status_and_error() -> None:
    # Status 0xA88: too hot.
    pairs = [*OFF, ("O 0 1", ""), *OFF, *[("R?", "2696")] * 2, ("E?", "ERROR 4:over temperature")]
    refusal = pytest.raises(CommandRejected, match=r"LED 1 on: .*too hot.*error 4 over temperature")
    with scripted(*wire(pairs)) as path, LineRegistry(clock=patient_clock()) as lines, refusal:
        opened(path, lines).set_light(True)


def test_status_bits_are_those_of_the_manual() -> None:
    # DC4100 manual rev. 2.2, page 28: bits 5, 7, 9, 11 no LED; bits 13, 15, 17, 19 LED open.
    assert [dc4100.missing_led(channel) for channel in range(4)] == [0x20, 0x80, 0x200, 0x800]
    assert [dc4100.open_led(channel) for channel in range(4)] == [0x2000, 0x8000, 0x20000, 0x80000]
    assert (dc4100.SUPPLY_FAILS, dc4100.TOO_HOT) == (0x2, 0x8)
