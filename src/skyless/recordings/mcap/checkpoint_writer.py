"""Objects as a graph of nodes (``checkpoint_graph``)."""

import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any, Final

import numpy as np

from skyless.recordings.mcap.checkpoint_graph import PLAIN, RECORDS, Arrays, Node, fields_of, holds_arrays, is_ours

_INT64: Final = 1 << 63


def write_graph(root: object, arrays: Arrays) -> list[Node]:
    """The nodes of everything that can be reached from ``root``.

    Raises:
        TypeError: something has no form here, or holds arrays without being in ``arrays``.
    """
    return _Writer(arrays).write(root)


class _Writer:
    def __init__(self, arrays: Arrays) -> None:
        self._arrays = arrays
        self._nodes: list[Node] = []
        self._number: dict[int, int] = {}
        self._kept: list[object] = []
        """Keeps what is numbered alive, so that no other object gets its id."""

    def write(self, root: object) -> list[Node]:
        self._of(root)
        return self._nodes

    def _of(self, value: object) -> int:
        """Number of the value's node."""
        number = self._number.get(id(value))
        if number is None:
            number = self._number[id(value)] = len(self._nodes)
            self._kept.append(value)
            self._nodes.append([])
            self._nodes[number] = self._node(value)
        return number

    def _all(self, values: Iterable[object]) -> list[int]:
        return [self._of(value) for value in values]

    def _node(self, value: object) -> Node:
        if type(value) in PLAIN:
            return ["=", value]
        writer = _WRITERS.get(type(value))
        if writer is not None:
            return writer(self, value)
        if isinstance(value, np.generic):
            return ["scalar", value.dtype.str, value.tobytes()]
        if isinstance(value, type):
            return ["class", *_place(value)]
        if isinstance(value, Enum):
            return ["enum", *_place(type(value)), value.name]
        return self._object(value)

    def _object(self, value: object) -> Node:
        place = _place(type(value))
        if isinstance(value, tuple):
            return ["named", *place, self._all(value)]
        if type(value) not in self._arrays and holds_arrays(value):
            raise TypeError(f"{type(value).__qualname__} holds arrays, but nothing says what must hold of them")
        fields = fields_of(value)
        return ["object", *place, list(fields), self._all(fields.values())]

    def _int(self, value: int) -> Node:
        return ["=", value] if -_INT64 <= value < _INT64 else ["int", str(value)]

    def _list(self, value: list[object]) -> Node:
        return ["list", self._all(value)]

    def _tuple(self, value: tuple[object, ...]) -> Node:
        return ["tuple", self._all(value)]

    def _set(self, value: set[object]) -> Node:
        return ["set", self._all(value)]

    def _frozenset(self, value: frozenset[object]) -> Node:
        return ["frozenset", self._all(value)]

    def _deque(self, value: deque[object]) -> Node:
        return ["deque", self._all(value), value.maxlen]

    def _dict(self, value: dict[object, object]) -> Node:
        return ["dict", self._all(value), self._all(value.values())]

    def _counter(self, value: Counter[object]) -> Node:
        return ["counter", self._all(value), self._all(value.values())]

    def _array(self, value: np.ndarray[Any, Any]) -> Node:
        kind = next((name for name, record in RECORDS.items() if value.dtype == record), value.dtype.str)
        if value.dtype.kind not in "biuf" and kind not in RECORDS:
            raise TypeError(f"an array of {value.dtype} has no form here")
        if value.base is not None and any(
            other is not value and isinstance(other, np.ndarray) and np.may_share_memory(other, value)
            for other in self._kept
        ):
            raise TypeError("arrays that share their memory have no form here")
        fortran = value.flags.f_contiguous and not value.flags.c_contiguous
        data = value.tobytes("F" if fortran else "C")
        return ["array", kind, list(value.shape), fortran, value.flags.writeable, data]


_WRITERS: Final[dict[type, Callable[[_Writer, Any], Node]]] = {
    int: _Writer._int,
    list: _Writer._list,
    tuple: _Writer._tuple,
    set: _Writer._set,
    frozenset: _Writer._frozenset,
    deque: _Writer._deque,
    dict: _Writer._dict,
    Counter: _Writer._counter,
    np.ndarray: _Writer._array,
}


def _place(kind: type) -> tuple[str, str]:
    """Module and name of a class that may be part of a graph."""
    if not is_ours(kind.__module__) or getattr(sys.modules[kind.__module__], kind.__qualname__, None) is not kind:
        raise TypeError(f"{kind.__module__}.{kind.__qualname__} has no form here")
    return kind.__module__, kind.__qualname__
