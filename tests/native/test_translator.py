"""What the translator takes has the same bits in C; what it does not take is refused with its line."""

import ctypes
import importlib.util
import inspect
import random
import struct
import subprocess
import sys
import typing
from pathlib import Path

import pytest
import translated
from core_build import EXACT, needs
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.core.native.records import Record, Ticks
from translator.body import RefusedError
from translator.files import translate

FUNCTIONS = [f for f in vars(translated).values() if inspect.isfunction(f) and f.__module__ == translated.__name__]
EXPORTED = [f for f in FUNCTIONS if not f.__name__.startswith("_")]
OF_NUMBERS = [f for f in EXPORTED if f.__name__ not in ("choose", "work", "stamp", "ignore")]
REALS = st.floats(-1e6, 1e6) | st.sampled_from([0.0, -0.0, 0.5, 1.0, -1.0])
VALUES = {int: st.integers(-40, 40), Ticks: st.integers(-(2**40), 2**40), float: REALS, bool: st.booleans()}
TYPES = {int: ctypes.c_int32, Ticks: ctypes.c_int64, float: ctypes.c_double, bool: ctypes.c_bool, type(None): None}
WARNINGS = ("-Wall", "-Wextra", "-Wdouble-promotion", "-Werror", "-Wno-unused-function")


COMPILER = ("gcc", *EXACT, "-O2", *WARNINGS)


def write(folder, name, *what):
    """The files of translated functions."""
    for text, suffix in zip(translate(what[0], name, *what[1:]), ("h", "c"), strict=True):
        (folder / f"{name}.{suffix}").write_text(text)


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """The functions of ``translated``; in single precision they compile without a warning, too."""
    folder = tmp_path_factory.mktemp("translated")
    write(folder, "examples", EXPORTED)
    subprocess.run([*COMPILER, "-shared", "-fPIC", "examples.c", "-o", "examples.so"], cwd=folder, check=True)
    subprocess.run([*COMPILER, "-DSKYLESS_FLOAT", "-c", "examples.c", "-o", "other.o"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "examples.so"))


def bound(library, function):
    """A translated function, called with its Python's types."""
    hints = typing.get_type_hints(function, include_extras=True)
    made = library[f"skyless_{function.__name__}"]
    made.restype = TYPES[hints.pop("return")]
    made.argtypes = [TYPES.get(hint, ctypes.c_void_p) for hint in hints.values()]
    return made


@pytest.mark.site
@needs("gcc")
@pytest.mark.parametrize("function", OF_NUMBERS, ids=lambda f: f.__name__)
def test_functions_of_numbers_give_the_bits_that_python_gives(library, function):
    hints = typing.get_type_hints(function, include_extras=True)
    form = "<d" if hints.pop("return") is float else "<q"
    made = bound(library, function)

    @settings(max_examples=60, deadline=None, database=None)
    @given(st.tuples(*(VALUES[hint] for hint in hints.values())))
    def compare(arguments):
        assert struct.pack(form, made(*arguments)) == struct.pack(form, function(*arguments))

    compare()


def fill(value, draw):
    """Random numbers in a record or an array, but nothing between them."""
    if isinstance(value, Record):
        for name, kind in value._fields_:
            place = getattr(value, name)
            fill(place, draw) if isinstance(place, Record | ctypes.Array) else setattr(value, name, drawn(kind, draw))
    else:
        for n, place in enumerate(value):
            if isinstance(place, Record | ctypes.Array):
                fill(place, draw)
            else:
                value[n] = drawn(value._type_, draw)


def drawn(kind, draw):
    return draw.uniform(-9, 9) if kind is ctypes.c_double else draw.randrange(2 if kind is ctypes.c_bool else 99)


@pytest.mark.site
@needs("gcc")
def test_functions_of_records_leave_the_bytes_that_python_leaves(library):
    for seed in range(20):
        draw, box = random.Random(seed), translated.Box()
        fill(box, draw)
        box.ticks += draw.choice([0, 1 << 35])
        other = translated.Box.from_buffer_copy(bytes(box))
        for name, argument in (("work", 1.25), ("choose", seed), ("ignore", 3)):
            function = getattr(translated, name)
            assert bound(library, function)(ctypes.byref(other), argument) == function(box, argument)
            assert bytes(other) == bytes(box)
        assert bound(library, translated.stamp)(box.bytes) == translated.stamp(box.bytes)


OF_SIZES = """
from typing import Annotated, Final

from skyless.core.native.records import Reals, Record, record
from skyless.core.native.records import MAX_RELAYS, PACKED

HALF: Final = MAX_RELAYS // 2 if PACKED else MAX_RELAYS


@record
class Sized(Record):
    numbers: Annotated[Reals, 3 + HALF]


def by_hand(one: Sized) -> int:
    return 1


def function(one: Sized) -> int:
    return HALF + by_hand(one)
"""


@pytest.mark.site
@needs("gcc")
def test_what_follows_from_sizes_has_those_of_the_compiler(tmp_path):
    """And a function that a target has by hand is its own."""
    module = module_of(tmp_path, OF_SIZES)
    write(tmp_path, "sized", [module.function], [module.by_hand])
    (tmp_path / "hand.h").write_text("INTERNAL int32_t by_hand(Sized *one) { return 100 + (one == 0); }\n")
    (tmp_path / "run.c").write_text(
        '#include <stdio.h>\n#include "sized.h"\nint main(void) { Sized one; '
        'printf("%d %d", (int)(sizeof one / sizeof(double)), (int)skyless_function(&one)); }\n'
    )
    less, by_hand = "-DMAX_RELAYS=9", '-DSKYLESS_BY_HAND="hand.h"'
    for flags, length, result in (
        ((), 3 + 32, 32 + 1),
        ((by_hand,), 3 + 32, 32 + 100),
        ((less,), 3 + 9, 9 + 1),
        ((less, "-DPACKED=true", by_hand), 3 + 4, 4 + 100),
    ):
        subprocess.run(["gcc", *EXACT, *flags, "sized.c", "run.c", "-o", "run"], cwd=tmp_path, check=True)
        output = subprocess.run([tmp_path / "run"], capture_output=True, text=True, check=True).stdout
        assert output == f"{length} {result}"


HEAD = """\
from math import tan
from typing import Annotated
import numpy as np
from skyless.core.native.arithmetic import floor, sqrt
from skyless.core.native.records import *
LENGTH = 3
@record
class Point(Record):
    x: float
    n: int
    values: Annotated[Reals, LENGTH]
    others: Annotated[Reals, LENGTH]
def change(p: Point) -> int:
    p.n += 1
    return p.n
def function(p: Point, i: int, t: Ticks, x: float, on: bool) -> float:
"""
BESIDE = "may write what is read beside it"
REFUSED = {
    "for k in range(i):\n  i += k\n else:\n  i = 0": "for NAME in range",
    "for k in p.values:\n  i += 1": "for NAME in range",
    "for k in range(i):\n  k += 1": "assigned within its loop",
    "for k in range(i):\n  for k in range(i):\n   i += k": "assigned within its loop",
    "for k in range(i):\n  i += k\n return k": "used beside its loop",
    "for k in range(0, 9, i):\n  i += k": "step of a range",
    "while on:\n  i += 1\n else:\n  i = 0": "While is not translated",
    "try:\n  i = 1\n finally:\n  i = 2": "Try is not translated",
    "def inner() -> None:\n  pass": "FunctionDef is not translated",
    "x": "Expr is not translated",
    "y = [x for _ in range(3)]": "ListComp is not translated",
    "y = p.values[1:]": "Slice is not translated",
    "y = p.values[-1]": "from the first one",
    "y = 'text'": "Constant is not translated",
    "y = x**2": "whole numbers",
    "y = x // 2.0": "whole numbers",
    "y = tan(x)": "no function that can be translated",
    "y = np.sqrt(x)": "by their names",
    "y = p.z": "Point has no field z",
    "y = unknown": "unknown is neither",
    "x = y\n y = 1.0": "y is neither",
    "i = t": "declare it as Ticks",
    "y = i\n y = x": "int32_t is wanted",
    "p.n = x": "int32_t is wanted",
    "y = on\n y = i": "bool is wanted",
    "y = i and on": "a comparison or a bool",
    "y: str = 1": "str is no type of C",
    "y = p.n + change(p)": BESIDE,
    "y = 0.5 < change(p) < p.n": BESIDE,
    "p.values[p.n] = change(p)": BESIDE,
    "p.n += change(p)": BESIDE,
    "y = 0 < change(p) < 7": "more than once",
    "y = p.x = change(p)": "more than once",
    "p.values = p.others": "cannot be assigned to",
    "p = 5": "p is Point",
    "y = p\n y = p.values": "y is Point",
    "y = Point().x": "have a name",
    "y = change(Point())": "needs a name",
    "y = Point(1.0)": "has no values",
    "y = change()": "no value for p",
    "y = change(p, p)": "1 parameters",
    "y = abs(x, x)": "number of arguments",
    "y = 12345678901234567890": "more than 64 bits",
    "y = p.values + 1": "for numbers",
}


def module_of(folder, text):
    path = folder / f"refused_{abs(hash(text))}.py"
    path.write_text(text)
    specification = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(specification)
    sys.modules[path.stem] = module
    specification.loader.exec_module(module)
    return module


PLAIN = "from typing import Annotated\nfrom skyless.core.native.records import *\n"
SIGNATURES = {
    "def function(x) -> None:": "need a type",
    "def function(x: float):": "need a type",
    "def function(*x: float) -> None:": "need a type",
    "def function(x: str) -> None:": "str is no type of C",
    "def function(x: Matrix) -> None:": "needs its lengths",
    "def function(x: float) -> Reals:": "returns an array",
    "def function(x: float) -> tuple[str, int]:": "str is no type of C",
}
CASES = [(f"{PLAIN}{signature}\n    pass\n", 3, 3, reason) for signature, reason in SIGNATURES.items()]
"""Modules, the first and the last line that may be named, and the reason."""
for statement, reason in REFUSED.items():
    used = " return x if on else float(y)\n" if statement.startswith("y") else " return x\n"
    first = HEAD.count("\n")
    CASES.append((f"{HEAD} {statement}\n{used}", first, first + 2 + statement.count("\n"), reason))


@pytest.mark.parametrize(("text", "first", "last", "reason"), CASES)
def test_what_is_outside_the_subset_is_refused_with_its_line(tmp_path, text, first, last, reason):
    with pytest.raises(RefusedError) as refused:
        translate([module_of(tmp_path, text).function], "refused")
    path, line, said = str(refused.value).split(":", 2)
    assert Path(path).parent == tmp_path
    assert first <= int(line) <= last
    assert reason in said


def test_two_functions_or_constants_of_one_name_are_refused(tmp_path):
    functions = "def _one() -> int:\n return 1\ndef one() -> int:\n return 2\n"
    for text, reason in (
        (f"{functions}def function() -> int:\n return _one() + one()\n", "two functions are called one"),
        ("A = 1\n_A = 2\ndef function() -> int:\n return A + _A\n", "another constant of this name is 1"),
    ):
        with pytest.raises(RefusedError, match=reason):
            translate([module_of(tmp_path, text).function], "refused")
