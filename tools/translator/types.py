"""Types, and expressions in C that have one."""

from collections.abc import Sequence
from ctypes import Array, c_bool, c_double, c_int32, c_int64, c_uint8
from math import isfinite, isnan
from typing import Any, Final, NamedTuple, get_args, get_origin

from skyless.core.native.records import Record, c_type


class Number(NamedTuple):
    """A type of numbers, by its name in C."""

    name: str


BOOL, INT, LONG, BYTE, REAL = (Number(name) for name in ("bool", "int32_t", "int64_t", "uint8_t", "real"))
OF_CTYPE: Final = {c_bool: BOOL, c_int32: INT, c_int64: LONG, c_uint8: BYTE, c_double: REAL}


class Struct(NamedTuple):
    """A record."""

    made: type[Record]


class Elements(NamedTuple):
    """An array; its length as C has it, nothing where it is a parameter."""

    element: "Type"
    length: str


class Results(NamedTuple):
    """Several numbers that a function returns."""

    function: str
    items: tuple[Number, ...]


Type = Number | Struct | Elements | Results


def type_of(ctype: Any, lengths: Sequence[str] = ()) -> Type:  # noqa: ANN401 - ctypes have no common type
    """The type of a ctype; of an array with these lengths, or those that it has.

    Raises:
        TypeError: C has none for it.
    """
    if isinstance(ctype, type) and issubclass(ctype, Array):
        length = (lengths and lengths[0]) or str(ctype._length_)
        return Elements(type_of(ctype._type_, lengths[1:]), length)  # type: ignore[arg-type]
    if isinstance(ctype, type) and issubclass(ctype, Record):
        return Struct(ctype)
    if ctype not in OF_CTYPE:
        raise TypeError(f"{getattr(ctype, '__name__', ctype)} is no type of C")
    return OF_CTYPE[ctype]


def declared(kind: Type, name: str) -> str:
    """The declaration of a variable or parameter; arrays and records are references."""
    if isinstance(kind, Number):
        return f"{kind.name} {name}"
    if isinstance(kind, Results):
        return f"{kind.function}_results {name}"
    if isinstance(kind, Struct):
        return f"{kind.made.__name__} *{name}"
    lengths, element = "", kind.element
    while isinstance(element, Elements):
        lengths, element = f"{lengths}[{element.length}]", element.element
    base = element.name if isinstance(element, Number) else element.made.__name__  # type: ignore[union-attr]
    return f"{base} (*{name}){lengths}" if lengths else f"{base} *{name}"


def parameter_type(hint: Any, lengths: Sequence[str] = ()) -> Type:  # noqa: ANN401
    """The type of an annotation of a parameter or result, with these lengths.

    Raises:
        TypeError: C has none for it.
    """
    if get_origin(hint) is tuple:
        items = tuple(type_of(c_type(item)) for item in get_args(hint))
        if not all(isinstance(item, Number) for item in items):
            raise TypeError("only numbers are returned together")
        return Results("", items)  # type: ignore[arg-type]
    origin = get_origin(hint)
    if origin is not None and origin.__name__ in {"Array", "ReadOnly"}:
        element = parameter_type(get_args(hint)[0])
        if isinstance(element, Elements) and not element.length:
            raise TypeError("an array of arrays needs its lengths")
        return Elements(element, "")
    return type_of(c_type(hint), lengths)


# Expressions

NEW: Final = 21
"""Rank of a new record."""


class Value(NamedTuple):
    """An expression in C."""

    code: str
    kind: Type
    rank: int = 20
    """How closely its operator binds, as in C; 20 where there is none."""
    is_pointer: bool = True
    """Of a record: whether it is a reference, and not the record itself."""


def as_operand(value: Value, rank: int) -> str:
    """Its code where an operator of a rank stands beside it."""
    return value.code if value.rank >= rank else f"({value.code})"


def converted(value: Value, kind: Type) -> Value:
    """The value as a number of a type."""
    if value.kind == kind or kind != REAL:
        return value
    return Value(f"(real){as_operand(value, 15)}", REAL, 15)


def common(one: Number, other: Number) -> Number:
    """The type of a result of arithmetic with two numbers."""
    if REAL in (one, other):
        return REAL
    return LONG if LONG in (one, other) else INT


def literal(number: float) -> Value:
    """A number as C writes it."""
    if isinstance(number, bool):
        return Value("true" if number else "false", BOOL)
    if isinstance(number, int):
        kind = INT if -(2**31) <= number < 2**31 else LONG
        code = str(number) if kind == INT else f"INT64_C({number})"
        return Value(code, kind, 20 if number >= 0 else 15)
    if not isfinite(number):
        return Value(
            '(real)__builtin_nan("")' if isnan(number) else f"(real){'-' * (number < 0)}__builtin_inf()", REAL, 15
        )
    return Value(f"REAL({number!r})", REAL)
