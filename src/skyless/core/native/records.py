"""Types of the functions that are also translated to C (``tools/translator``): numbers, records and their arrays.

A record is a ``ctypes`` structure, so it has the layout of the C structure of the same name and both work on the same
memory. Its fields are declared like those of a dataclass; arrays in it have fixed lengths:

    @record
    class Track(Record):
        count: int
        rx_ticks: Ticks
        position_m: Annotated[Reals, 3]
        P: Annotated[Matrix, STATES, STATES]
        anchors: Annotated[Array[Anchor], MAX_ANCHORS]

An element that is itself an array or a record is a reference: ``row = P[one]`` and ``a = anchors[index]`` copy nothing,
``anchors[index] = anchors[other]`` copies. A new record is all zeros.
"""

import ctypes
from collections.abc import Iterator
from math import nan
from typing import Annotated, Any, ClassVar, Final, Protocol, Self, TypeVar, get_args, get_origin, get_type_hints

Value = TypeVar("Value")
Read_co = TypeVar("Read_co", covariant=True)
Made = TypeVar("Made", bound="Record")

Ticks = Annotated[int, ctypes.c_int64]
"""A 64-bit integer. A plain ``int`` has 32 bits: counts and indices."""

Count = Annotated[int, ctypes.c_int64]
"""The same, for counters that grow for years."""

Byte = Annotated[int, ctypes.c_uint8]

REAL: Final = ctypes.c_double
"""The type of a record's ``float``; C's ``real``."""

_C_TYPES: Final[dict[object, Any]] = {int: ctypes.c_int32, bool: ctypes.c_bool, float: REAL}


class Array(Protocol[Value]):
    """Contiguous elements."""

    def __getitem__(self, index: int, /) -> Value:
        """The element, or a reference to it."""

    def __setitem__(self, index: int, value: Value, /) -> None:
        """Copy a value into the element."""

    def __iter__(self) -> Iterator[Value]:
        """All elements; not for translated functions."""


class ReadOnly(Protocol[Read_co]):
    """Elements that are only read; also ``bytes``."""

    def __getitem__(self, index: int, /) -> Read_co:
        """The element."""


Reals = Array[float]
Matrix = Array[Array[float]]
Integers = Array[int]
Bytes = ReadOnly[Byte]


class Record(ctypes.Structure):
    """Base of all records."""

    _names_: ClassVar[tuple[str, ...]] = ()
    _defaults_: ClassVar[dict[str, Any]] = {}
    _nested_: ClassVar[tuple[str, ...]] = ()
    """Fields that are records with defaults of their own."""

    def __init__(self, **values: Any) -> None:  # noqa: ANN401 - of fields
        """Set all fields to zero, their default or the given value; NaN for a number that is None.

        Raises:
            TypeError: there is no such field.
        """
        super().__init__()
        self._set_defaults()
        self._set(values)

    def changed(self, **values: Any) -> Self:  # noqa: ANN401 - of fields
        """A copy with other values in these fields. Raises TypeError: there is no such field."""
        copy = type(self).from_buffer_copy(self)
        copy._set(values)
        return copy

    def values(self) -> dict[str, Any]:
        """The fields by name."""
        return {name: getattr(self, name) for name in self._names_}

    def _set_defaults(self) -> None:
        self._set(self._defaults_)
        for name in self._nested_:
            getattr(self, name)._set_defaults()

    def _set(self, values: dict[str, Any]) -> None:
        for name, value in values.items():
            if name not in self._names_:
                raise TypeError(f"{type(self).__name__} has no field {name}")
            setattr(self, name, nan if value is None else value)


def record(made: type[Made]) -> type[Made]:
    """Create a record's fields and defaults from its annotations."""
    hints = get_type_hints(made, include_extras=True)
    made._names_ = tuple(name for name in hints if not name.startswith("_"))
    made._defaults_ = {name: made.__dict__[name] for name in made._names_ if name in made.__dict__}
    made._fields_ = [(name, c_type(hints[name])) for name in made._names_]
    made._nested_ = tuple(name for name, kind in made._fields_ if has_defaults(kind))  # type: ignore[misc]
    return made


def has_defaults(kind: Any) -> bool:  # noqa: ANN401 - types have no type
    """Whether a type is a record whose new instances are not all zeros."""
    return isinstance(kind, type) and issubclass(kind, Record) and bool(kind._defaults_ or kind._nested_)


def c_type(hint: Any) -> Any:  # noqa: ANN401 - types have no type
    """The ctypes type of a field's annotation."""
    if get_origin(hint) is not Annotated:
        return _C_TYPES.get(hint, hint)
    base, *extras = get_args(hint)
    if isinstance(extras[0], type):
        return extras[0]
    element = base
    for _ in extras:
        element = get_args(element)[0]
    found = c_type(element)
    for length in reversed(extras):
        found *= length
    return found


def first(array: Array[Value], count: int) -> list[Value]:
    """The first elements of an array; records are references."""
    return [array[index] for index in range(count)]


# Sizes of records on a computer; a board has others (``firmware/source/core_sizes.h``), which its compiler gives C.

MAX_ANCHORS: Final = 32
"""Most anchors in the state."""
PACKETS_KEPT: Final = 16
"""Packets kept of each anchor for later relays; divides the range of sequence numbers."""
MAX_RELAYS: Final = 32
"""Most relays with a packet; 13 fit into a frame."""
PHASE_STATES: Final = 2
"""States of each anchor for carrier phases; 0 if they are not used."""
HYPOTHESES: Final = 16
"""Most hypotheses on cycles of phases; 0 if phases are not used."""
MOTION_STATES: Final = 5
"""States for a motion sensor; 0 if none can be used."""
PLANNED_FAULTS: Final = 13
"""Columns of V for planning: walls, and four impulses along each axis."""
MOST_WAITING: Final = 8
"""Most queued updates of the filter."""
PACKED: Final = False
"""Whether P is kept as a lower triangle: half the memory, but rows that do not fit vectors."""
MAX_NEIGHBOURS: Final = 256
"""Most anchors known from their own beacons."""
MAX_SITES: Final = 8
"""Most sites whose anchors are counted."""
MAX_COUNTED: Final = 32
"""Most anchors counted of each."""
MAX_ANCHORS_IN_USE: Final = 24
"""Most anchors in a tag's state; more reduce accuracy, as each then sends less, and take time."""
RELAYS_KEPT: Final = 32
"""Relays kept of each packet for the filter's start."""
MAX_PAGES: Final = 64
"""Most collected pages of incomplete issues."""
MAX_SENDERS: Final = 16
"""Most senders counted for a page."""
SHARES_MEMORY: Final = False
"""Whether the search for a start uses the memory of the state, which is unused meanwhile."""
HAS_ORIGIN: Final = False
"""Whether positions are relative to whole metres near the first anchor, so that single precision suffices."""
