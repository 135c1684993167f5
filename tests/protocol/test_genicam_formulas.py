"""Formulas and registers of GenICam descriptions."""

import pytest

from simulators.camera.genicam.formula import Formula, FormulaError
from simulators.camera.genicam.register import Register, RegisterMemory


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1+2*3", 7),
        ("10-2-3", 5),
        ("-7/2", -3),
        ("-7%3", -1),
        ("2**10-1", 1023),
        ("-2**2", -4),
        ("(A=1)?0x10:(A<>2)?0x20:0x30", 0x20),
        ("(A=0)&&(B=5)||0", 1),
        ("((B&0x4)>>2)|0x80", 0x81),
        ("6^3&1", 7),
        ("~0", -1),
        ("1<<4>=16", 1),
        ("X.Max - ABS(-B)", 95),
        (".5e1+A", 5),
    ],
)
def test_whole_numbers(text: str, value: int) -> None:
    assert Formula(text, integer=True).value({"A": 0, "B": 5, "X.Max": 100}.__getitem__) == value


@pytest.mark.parametrize(
    ("text", "value"),
    [("7/2", 3.5), ("FROM*(2**BITS)", 12.0), ("ROUND(2.5)", 3.0), ("round(2.345, 1)", 2.3), ("SQRT(16)+PI-PI", 4.0)],
)
def test_real_numbers(text: str, value: float) -> None:
    assert Formula(text, integer=False).value({"FROM": 3, "BITS": 2}.__getitem__) == pytest.approx(value)


NESTED = ("(" * 100 + "1" + ")" * 100, "-" * 100 + "1", "1+" * 40_000 + "1")


@pytest.mark.parametrize(
    "text", ["", "1+", "(1", "1 2", "$", "9**9**9**9", "1<<999999", "1/0", "NOBODY", "BESSEL(1)", *NESTED]
)
def test_what_has_no_value_is_refused_at_once(text: str) -> None:
    with pytest.raises(FormulaError):
        Formula(text, integer=True).value({}.__getitem__)


def test_registers_keep_byte_order_sign_and_the_fields_beside_them() -> None:
    memory = RegisterMemory()
    memory.write(0x1FFE, bytes([0x12, 0x34, 0x56, 0x78]))
    assert Register(0x1FFE, 4, big_endian=True).number(memory) == 0x12345678
    assert Register(0x1FFE, 4).number(memory) == 0x78563412
    field = Register(0x1FFE, 4, big_endian=True, signed=True, bits=(4, 11))
    assert field.number(memory) == 0x67
    field.set_number(memory, -2)
    assert field.number(memory) == -2
    assert memory.read(0x1FFE, 4) == bytes([0x12, 0x34, 0x5F, 0xE8])
    field.set_number(memory, 5000)
    assert field.number(memory) == 127
    for length, big in ((4, True), (8, False)):
        real = Register(0x4000, length, "real", big_endian=big)
        real.set_number(memory, -0.375)
        assert real.number(memory) == -0.375
