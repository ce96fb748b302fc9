"""A graph of nodes (``checkpoint_graph``), of unknown origin, as objects.

Reading makes containers, arrays of numbers, enum members, structs and plain objects of the protocol machine's own
classes, and calls nothing else.
"""

import re
from collections import Counter, deque
from collections.abc import Callable
from enum import Enum
from importlib import import_module
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import astuple

from skyless.recordings.mcap.checkpoint_graph import PLAIN, RECORDS, Arrays, Node, holds_arrays, is_ours

MOST_NODES: Final = 200_000

_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_KEYS: Final = (*PLAIN, int, Enum, type)
_FAULTS: Final = (
    *(AttributeError, ArithmeticError, ImportError, LookupError, MemoryError),
    *(RecursionError, TypeError, ValueError),
)


class DamagedGraphError(Exception):
    """The nodes are not what ``write_graph`` writes."""


def read_graph(nodes: list[Node], arrays: Arrays) -> object:
    """The root of a graph.

    Raises:
        DamagedGraphError: the nodes are not sound.
    """
    try:
        return _Reader(nodes, arrays).read()
    except _FAULTS as error:
        raise DamagedGraphError(str(error)) from None


class _Reader:
    def __init__(self, nodes: list[Node], arrays: Arrays) -> None:
        if len(nodes) > MOST_NODES:
            raise DamagedGraphError("too many nodes")
        self._nodes = nodes
        self._arrays = arrays
        self._made: dict[int, object] = {}
        self._begun: set[int] = set()
        self._objects: list[object] = []

    def read(self) -> object:
        root = self._value(0)
        for made in self._objects:
            sound = self._arrays.get(type(made))
            if holds_arrays(made) if sound is None else not sound(made):
                raise DamagedGraphError(f"arrays of {type(made).__qualname__}")
        return root

    def _value(self, number: int) -> object:
        if number in self._made:
            return self._made[number]
        if number in self._begun or type(number) is not int or number < 0:
            raise DamagedGraphError("a circle that cannot be, or no number")
        self._begun.add(number)
        kind, *rest = self._nodes[number]
        value = _READERS[kind](self, number, *rest)
        self._made[number] = value
        return value

    def _all(self, numbers: list[int]) -> list[object]:
        return [self._value(number) for number in numbers]

    def _plain(self, _: int, value: object) -> object:
        if type(value) not in PLAIN and type(value) is not int:
            raise DamagedGraphError("no plain value")
        return value

    def _int(self, _: int, text: str) -> int:
        return int(text)

    def _list(self, number: int, parts: list[int]) -> list[object]:
        made: list[object] = []
        self._made[number] = made
        made.extend(self._all(parts))
        return made

    def _deque(self, number: int, parts: list[int], maxlen: int | None) -> deque[object]:
        made: deque[object] = deque(maxlen=maxlen)
        self._made[number] = made
        made.extend(self._all(parts))
        return made

    def _tuple(self, _: int, parts: list[int]) -> tuple[object, ...]:
        return tuple(self._all(parts))

    def _named(self, _: int, module: str, name: str, parts: list[int]) -> tuple[object, ...]:
        kind = _find(module, name)
        if not issubclass(kind, tuple) or len(getattr(kind, "_fields", ())) != len(parts):
            raise DamagedGraphError("no named tuple")
        made: tuple[object, ...] = tuple.__new__(kind, self._all(parts))
        return made

    def _set(self, _: int, parts: list[int]) -> set[object]:
        return {_key(part) for part in self._all(parts)}

    def _frozenset(self, _: int, parts: list[int]) -> frozenset[object]:
        return frozenset(_key(part) for part in self._all(parts))

    def _dict(self, number: int, keys: list[int], values: list[int]) -> dict[object, object]:
        return self._fill(number, {}, keys, values)

    def _counter(self, number: int, keys: list[int], values: list[int]) -> dict[object, object]:
        return self._fill(number, Counter(), keys, values)

    def _fill(self, number: int, made: dict[Any, Any], keys: list[int], values: list[int]) -> dict[object, object]:
        self._made[number] = made
        for key, value in zip(keys, values, strict=True):
            made[_key(self._value(key))] = self._value(value)
        return made

    def _array(self, _: int, dtype: str, shape: list[int], fortran: bool, writeable: bool, data: bytes) -> object:
        if not all(type(size) is int and size >= 0 for size in shape):
            raise DamagedGraphError("no shape")
        array = np.frombuffer(data, _dtype(dtype)).reshape(shape, order="F" if fortran else "C").copy("K")
        array.flags.writeable = bool(writeable)
        return array

    def _scalar(self, _: int, dtype: str, data: bytes) -> object:
        scalar: object = np.frombuffer(data, _dtype(dtype))[0]
        return scalar

    def _class(self, _: int, module: str, name: str) -> type:
        return _find(module, name)

    def _enum(self, _: int, module: str, kind: str, name: str) -> Enum:
        found = _find(module, kind)
        if not issubclass(found, Enum):
            raise DamagedGraphError("no enum")
        return found[name]

    def _object(self, number: int, module: str, name: str, fields: list[str], values: list[int]) -> object:
        kind = _find(module, name)
        if issubclass(kind, Struct):
            return self._struct(kind, fields, values)
        if issubclass(kind, Enum | BaseException | type) or kind.__new__ is not object.__new__:
            raise DamagedGraphError("no plain object")
        made = self._made[number] = object.__new__(kind)
        self._objects.append(made)
        for field, value in zip(fields, values, strict=True):
            if not _NAME.fullmatch(field) or field.startswith("__"):
                raise DamagedGraphError("no attribute")
            object.__setattr__(made, field, self._value(value))
        return made

    def _struct(self, kind: type[Struct], fields: list[str], values: list[int]) -> object:
        if tuple(fields) != kind.__struct_fields__:
            raise DamagedGraphError("other fields")
        made = kind(**dict(zip(fields, self._all(values), strict=True)))
        self._objects.append(made)
        return made


_READERS: Final[dict[str, Callable[..., object]]] = {
    "=": _Reader._plain,
    "int": _Reader._int,
    "list": _Reader._list,
    "tuple": _Reader._tuple,
    "named": _Reader._named,
    "set": _Reader._set,
    "frozenset": _Reader._frozenset,
    "deque": _Reader._deque,
    "dict": _Reader._dict,
    "counter": _Reader._counter,
    "array": _Reader._array,
    "scalar": _Reader._scalar,
    "class": _Reader._class,
    "enum": _Reader._enum,
    "object": _Reader._object,
}


def _find(module: str, name: str) -> type:
    if not is_ours(module) or not all(_NAME.fullmatch(part) for part in (*module.split("."), name)):
        raise DamagedGraphError("a class from elsewhere")
    found = vars(import_module(module)).get(name)
    if not isinstance(found, type) or found.__module__ != module:
        raise DamagedGraphError("no class")
    return found


def _dtype(name: str) -> np.dtype[Any]:
    if name in RECORDS:
        return RECORDS[name]
    found = np.dtype(name)
    if found.kind not in "biuf":
        raise DamagedGraphError("no numbers")
    return found


def _key(value: object) -> object:
    """A key whose hash takes no time that somebody could abuse: plain, or a tuple or frozen struct of plain values."""
    parts = value if type(value) is tuple else (value,)
    if isinstance(value, Struct) and value.__struct_config__.frozen:
        parts = astuple(value)
    if not all(isinstance(part, _KEYS) for part in parts):
        raise DamagedGraphError("no key")
    return value
