"""Formulas of GenICam nodes (`SwissKnife`, `Converter`): operators of C, with `=`, `<>`, `**` and some functions."""

import math
import operator
import re
from collections.abc import Callable
from functools import partial

Number = int | float
LookUp = Callable[[str], Number]
Term = Callable[[LookUp], Number]

_TOKEN = re.compile(
    r"\s*(0[xX][0-9a-fA-F]+|(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|[A-Za-z_][\w.]*"
    r"|\*\*|&&|\|\||<>|<=|>=|<<|>>|[-+*/%&|^~<>=?:(),])"
)
_MOST_CHARACTERS = 1 << 16
_DEEPEST = 60
# Exponents and shifts beyond this are no camera's, and would take hours.
_LARGEST_SHIFT = 64

_FUNCTIONS: dict[str, Callable[..., Number]] = {
    "ABS": abs,
    "SGN": lambda x: (x > 0) - (x < 0),
    "NEG": operator.neg,
    "TRUNC": math.trunc,
    "FLOOR": math.floor,
    "CEIL": math.ceil,
    "ROUND": lambda x, digits=0: round(x, int(digits)) if digits else math.floor(abs(x) + 0.5) * (1 if x >= 0 else -1),
    "SQRT": math.sqrt,
    "EXP": math.exp,
    "LN": math.log,
    "LG": math.log10,
    "SIN": math.sin,
    "COS": math.cos,
    "TAN": math.tan,
    "ASIN": math.asin,
    "ACOS": math.acos,
    "ATAN": math.atan,
}
_CONSTANTS = {"PI": math.pi, "E": math.e}


class FormulaError(Exception):
    """A formula that cannot be read or has no value."""


def _power(a: Number, b: Number) -> Number:
    if isinstance(a, int) and isinstance(b, int) and 0 <= b <= _LARGEST_SHIFT and abs(a) < 1 << _LARGEST_SHIFT:
        return int(a**b)
    return math.pow(a, b)


def _divide(a: Number, b: Number) -> Number:
    if isinstance(a, int) and isinstance(b, int):
        # Towards zero, as C does.
        return abs(a) // abs(b) * (1 if (a < 0) == (b < 0) else -1)
    return a / b


def _remainder(a: Number, b: Number) -> Number:
    return a - b * int(_divide(a, b))


def _shift(a: Number, b: Number, *, left: bool) -> Number:
    if not 0 <= b <= _LARGEST_SHIFT:
        raise ValueError(f"a shift by {b}")
    return int(a) << int(b) if left else int(a) >> int(b)


# Precedence and operation of each; operators of equal precedence are left-associative.
_BINARY: dict[str, tuple[int, Callable[[Number, Number], Number]]] = {
    "||": (1, lambda a, b: int(bool(a) or bool(b))),
    "&&": (2, lambda a, b: int(bool(a) and bool(b))),
    "|": (3, lambda a, b: int(a) | int(b)),
    "^": (4, lambda a, b: int(a) ^ int(b)),
    "&": (5, lambda a, b: int(a) & int(b)),
    "=": (6, lambda a, b: int(a == b)),
    "<>": (6, lambda a, b: int(a != b)),
    "<": (7, lambda a, b: int(a < b)),
    ">": (7, lambda a, b: int(a > b)),
    "<=": (7, lambda a, b: int(a <= b)),
    ">=": (7, lambda a, b: int(a >= b)),
    "<<": (8, partial(_shift, left=True)),
    ">>": (8, partial(_shift, left=False)),
    "+": (9, operator.add),
    "-": (9, operator.sub),
    "*": (10, operator.mul),
    "/": (10, _divide),
    "%": (10, _remainder),
}


class Formula:
    """A formula read once.

    Parameters
    ----------
    text : at most 64 KiB.
    integer : True for those of whole numbers, in which a division cuts off what is behind the point.

    Raises
    ------
    FormulaError
        It cannot be read.
    """

    def __init__(self, text: str, *, integer: bool) -> None:
        self._text, self._integer = text, integer
        if len(text) > _MOST_CHARACTERS:
            raise FormulaError(f"has {len(text):,} characters")
        self._tokens = self._split(text)
        self._position = self._depth = 0
        self._term = self._choice()
        if self._position != len(self._tokens):
            raise FormulaError(f"{self._tokens[self._position]!r} is not expected there")

    def value(self, look_up: LookUp) -> Number:
        """Value with the variables that `look_up` knows by name. Raises FormulaError where it has none."""
        try:
            result = self._term(look_up)
            value = int(result) if self._integer else float(result)
            if not math.isfinite(value):
                raise ValueError(f"it is {value}")
            return value
        except (ArithmeticError, ValueError, TypeError) as why:
            raise FormulaError(f"{self._text[:80]!r} has no value ({why})") from why

    @staticmethod
    def _split(text: str) -> list[str]:
        tokens, position, text = [], 0, text.strip()
        while position < len(text):
            match = _TOKEN.match(text, position)
            if match is None:
                raise FormulaError(f"cannot be read from {text[position : position + 20]!r} on")
            tokens.append(match[1])
            position = match.end()
        return tokens

    def _next(self) -> str:
        return self._tokens[self._position] if self._position < len(self._tokens) else ""

    def _take(self, token: str) -> None:
        if self._next() != token:
            raise FormulaError(f"{token!r} is expected and {self._next() or 'the end'!r} comes")
        self._position += 1

    def _choice(self) -> Term:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise FormulaError(f"nested deeper than {_DEEPEST} levels")
        condition = self._binary()
        if self._next() == "?":
            self._position += 1
            first = self._choice()
            self._take(":")
            second = self._choice()
            self._depth -= 1
            return lambda look_up: first(look_up) if condition(look_up) else second(look_up)
        self._depth -= 1
        return condition

    def _binary(self, loosest: int = 0) -> Term:
        left = self._unary()
        while (sign := self._next()) in _BINARY and _BINARY[sign][0] >= loosest:
            self._position += 1
            precedence, operation = _BINARY[sign]
            left = _joined(operation, left, self._binary(precedence + 1))
        return left

    def _unary(self) -> Term:
        sign = self._next()
        if sign not in ("-", "+", "~"):
            return self._powered()
        self._position += 1
        term = self._nested(self._unary)
        if sign == "-":
            return lambda look_up: -term(look_up)
        return term if sign == "+" else lambda look_up: ~int(term(look_up))

    def _powered(self) -> Term:
        base = self._atom()
        if self._next() != "**":
            return base
        self._position += 1
        return _joined(_power, base, self._nested(self._unary))

    def _nested(self, parse: Callable[[], Term]) -> Term:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise FormulaError(f"nested deeper than {_DEEPEST} levels")
        term = parse()
        self._depth -= 1
        return term

    def _atom(self) -> Term:
        token = self._next()
        self._position += 1
        if token == "(":
            inner = self._choice()
            self._take(")")
            return inner
        if token[:1].isdigit() or token[:1] == ".":
            number = self._number(token)
            return lambda _: number
        if not (token[:1].isalpha() or token[:1] == "_"):
            raise FormulaError(f"{token or 'the end'!r} is not expected there")
        if self._next() == "(" and token.upper() in _FUNCTIONS:
            return self._call(_FUNCTIONS[token.upper()])
        # A variable may be called E.
        return lambda look_up: _variable(look_up, token)

    def _number(self, token: str) -> Number:
        if token[:2] in ("0x", "0X"):
            return int(token, 16)
        return int(token) if token.isdigit() and self._integer else float(token)

    def _call(self, function: Callable[..., Number]) -> Term:
        self._take("(")
        arguments = [self._choice()]
        while self._next() == ",":
            self._position += 1
            arguments.append(self._choice())
        self._take(")")
        return lambda look_up: function(*(argument(look_up) for argument in arguments))


def _joined(sign: Callable[[Number, Number], Number], left: Term, right: Term) -> Term:
    return lambda look_up: sign(left(look_up), right(look_up))


def _variable(look_up: LookUp, name: str) -> Number:
    try:
        return look_up(name)
    except KeyError:
        if name in _CONSTANTS:
            return _CONSTANTS[name]
        raise FormulaError(f"has an unknown variable {name!r}") from None
