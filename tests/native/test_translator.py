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
from core_build import EXACT, has
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.core.native.records import Record, Ticks

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from translator.body import RefusedError
from translator.files import translate

pytestmark = pytest.mark.site

ALL = [f for f in vars(translated).values() if inspect.isfunction(f) and f.__module__ == translated.__name__]
EXPORTED = [f for f in ALL if not f.__name__.startswith("_")]
OF_NUMBERS = [f for f in EXPORTED if f.__name__ not in ("choose", "work", "stamp", "ignore")]
REALS = st.floats(-1e6, 1e6) | st.sampled_from([0.0, -0.0, 0.5, 1.0, -1.0])
VALUES = {int: st.integers(-40, 40), Ticks: st.integers(-(2**40), 2**40), float: REALS, bool: st.booleans()}
TYPES = {int: ctypes.c_int32, Ticks: ctypes.c_int64, float: ctypes.c_double, bool: ctypes.c_bool, type(None): None}
WARNINGS = ("-Wall", "-Wextra", "-Wdouble-promotion", "-Werror", "-Wno-unused-function")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("translated")
    for text, suffix in zip(translate(EXPORTED, "examples"), ("h", "c"), strict=True):
        (folder / f"examples.{suffix}").write_text(text)
    return folder


@pytest.fixture(scope="module")
def library(files):
    if not has("gcc"):
        pytest.skip("there is no gcc")
    command = ["gcc", *EXACT, "-O2", *WARNINGS, "-shared", "-fPIC", "examples.c", "-o", "examples.so"]
    subprocess.run(command, cwd=files, check=True)
    return ctypes.CDLL(str(files / "examples.so"))


def bound(library, function):
    """A translated function, called with its Python's types."""
    hints = typing.get_type_hints(function, include_extras=True)
    made = library[f"skyless_{function.__name__}"]
    made.restype = TYPES[hints.pop("return")]
    made.argtypes = [TYPES.get(hint, ctypes.c_void_p) for hint in hints.values()]
    return made


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


@pytest.mark.parametrize("seed", range(20))
def test_functions_of_records_leave_the_bytes_that_python_leaves(library, seed):
    draw, box = random.Random(seed), translated.Box()
    fill(box, draw)
    box.ticks += draw.choice([0, 1 << 35])
    other = translated.Box.from_buffer_copy(bytes(box))
    assert bound(library, translated.work)(ctypes.byref(other), 1.25) == translated.work(box, 1.25)
    assert bound(library, translated.choose)(ctypes.byref(other), seed) == translated.choose(box, seed)
    assert bytes(other) == bytes(box)
    assert bound(library, translated.stamp)(box.bytes) == translated.stamp(box.bytes)
    bound(library, translated.ignore)(ctypes.byref(other), 3)
    translated.ignore(box, 3)
    assert bytes(other) == bytes(box)


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


@pytest.mark.skipif(not has("gcc"), reason="there is no gcc")
@pytest.mark.parametrize(
    ("flags", "length", "half"),
    [((), 3 + 32, 32), (("-DMAX_RELAYS=9",), 3 + 9, 9), (("-DMAX_RELAYS=9", "-DPACKED=true"), 3 + 4, 4)],
)
def test_what_follows_from_sizes_has_those_of_the_compiler(tmp_path, flags, length, half):
    """And a function that a target has by hand is its own."""
    module = module_of(tmp_path, OF_SIZES)
    for text, suffix in zip(translate([module.function], "sized", [module.by_hand]), ("h", "c"), strict=True):
        (tmp_path / f"sized.{suffix}").write_text(text)
    (tmp_path / "hand.h").write_text("INTERNAL int32_t by_hand(Sized *one) { return 100 + (one == 0); }\n")
    (tmp_path / "run.c").write_text(
        '#include <stdio.h>\n#include "sized.h"\nint main(void) { Sized one; '
        'printf("%d %d", (int)(sizeof one / sizeof(double)), (int)skyless_function(&one)); }\n'
    )
    for own, found in ((), 1), (('-DSKYLESS_BY_HAND="hand.h"',), 100):
        command = ["gcc", *EXACT, *flags, *own, "sized.c", "run.c", "-o", "run"]
        subprocess.run(command, cwd=tmp_path, check=True)
        output = subprocess.run([tmp_path / "run"], capture_output=True, text=True, check=True).stdout
        assert output == f"{length} {half + found}"


@pytest.mark.skipif(not has("gcc"), reason="there is no gcc")
def test_single_precision_compiles_without_warnings(files):
    command = ["gcc", *EXACT, *WARNINGS, "-DSKYLESS_FLOAT", "-c", "examples.c", "-o", "other.o"]
    subprocess.run(command, cwd=files, check=True)


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


def translate_text(folder, text):
    return translate([module_of(folder, text).function], "refused")


@pytest.mark.parametrize("statement", REFUSED)
def test_what_is_outside_the_subset_is_refused_with_its_line(tmp_path, statement):
    used = " return x if on else float(y)\n" if statement.startswith("y") else " return x\n"
    with pytest.raises(RefusedError) as refused:
        translate_text(tmp_path, f"{HEAD} {statement}\n{used}")
    path, line, reason = str(refused.value).split(":", 2)
    assert Path(path).parent == tmp_path
    assert HEAD.count("\n") <= int(line) <= HEAD.count("\n") + 2 + statement.count("\n")
    assert REFUSED[statement] in reason


SIGNATURES = {
    "def function(x) -> None:": "need a type",
    "def function(x: float):": "need a type",
    "def function(*x: float) -> None:": "need a type",
    "def function(x: str) -> None:": "str is no type of C",
    "def function(x: Matrix) -> None:": "needs its lengths",
    "def function(x: float) -> Reals:": "returns an array",
    "def function(x: float) -> tuple[str, int]:": "str is no type of C",
}


@pytest.mark.parametrize("signature", SIGNATURES)
def test_signatures_outside_the_subset_are_refused(tmp_path, signature):
    text = f"from typing import Annotated\nfrom skyless.core.native.records import *\n{signature}\n    pass\n"
    with pytest.raises(RefusedError, match=r"refused_\d+\.py:3: ") as refused:
        translate_text(tmp_path, text)
    assert SIGNATURES[signature] in str(refused.value)


def test_two_functions_or_constants_of_one_name_are_refused(tmp_path):
    functions = "def _one() -> int:\n return 1\ndef one() -> int:\n return 2\n"
    with pytest.raises(RefusedError, match="two functions are called one"):
        translate_text(tmp_path, f"{functions}def function() -> int:\n return _one() + one()\n")
    with pytest.raises(RefusedError, match="another constant of this name is 1"):
        translate_text(tmp_path, "A = 1\n_A = 2\ndef function() -> int:\n return A + _A\n")
