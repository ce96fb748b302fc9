"""How Python calls the library: each kind of argument, and what is said of one that is missing or of another source."""

import ctypes
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from core_build import NATIVE, needs

import compile_core
from skyless.core.errors import SkylessError
from skyless.core.native import library
from skyless.core.native.records import Array, Byte, Bytes, Integers, Reals, Record, Ticks, record
from skyless.core.native.views import view

pytestmark = [pytest.mark.site, needs("cc")]

SOURCE = """
#include <stdbool.h>
#include <stdint.h>
#include "skyless_core.h"
SKYLESS_EXPORT extern const char *const skyless_source_digest;
const char *const skyless_source_digest = SKYLESS_SOURCE_DIGEST;
typedef struct { int32_t count; double length_m; int64_t ticks; } Item;
SKYLESS_EXPORT double skyless_scalars(int32_t a, int64_t b, uint8_t c, bool d, double e) { return a + b + c + d + e; }
SKYLESS_EXPORT int64_t skyless_later(int64_t ticks) { return ticks + 1; }
SKYLESS_EXPORT bool skyless_is_long(Item *item) { return item->length_m > 1; }
SKYLESS_EXPORT void skyless_copy(Item *from, Item *to) { *to = *from; }
SKYLESS_EXPORT double skyless_sums(double *a, int32_t *b, int64_t *c, uint8_t *d, Item *e, int32_t count) {
    double sum = 0;
    for (int32_t n = 0; n < count; n++) sum += a[n] + b[n] + c[n] + d[n] + e[n].length_m;
    return sum;
}
"""


@record
class Item(Record):
    """A record of the source above."""

    count: int
    length_m: float
    ticks: Ticks


def scalars(a: int, b: Ticks, c: Byte, d: bool, e: float) -> float: ...


def later(ticks: Ticks) -> Ticks: ...


def is_long(item: Item) -> bool: ...


def copy(source: Item, target: Item) -> None: ...


def sums(a: Reals, b: Integers, c: Array[Ticks], d: Bytes, e: Array[Item], count: int) -> float: ...


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with the source above and its library."""
    folder = tmp_path_factory.mktemp("library")
    (folder / "skyless_core.c").write_text(SOURCE)
    (folder / "skyless_core.h").write_text('#define SKYLESS_EXPORT __attribute__((visibility("default")))\n')
    compile_core.compiled(folder, "skyless_core", "libskyless_core.so", [])
    return folder


@pytest.fixture
def folder(made, monkeypatch):
    """Where the library is looked for."""
    monkeypatch.delenv("SKYLESS_UNCOMPILED", raising=False)
    monkeypatch.setattr(library, "FOLDER", made)
    library.library.cache_clear()
    yield made
    library.library.cache_clear()


def test_numbers_keep_their_size_and_sign_and_records_are_given_in_place(folder):
    assert library.compiled(scalars)(-(2**31), 2**40, 255, True, 0.5) == -(2**31) + 2**40 + 256.5
    assert library.compiled(later)(-(2**62)) == 1 - 2**62
    item, other = Item(count=-3, length_m=1.5, ticks=2**50), Item()
    assert library.compiled(is_long)(item) is True
    assert library.compiled(is_long)(other) is False
    assert library.compiled(copy)(item, other) is None
    assert other.values() == item.values()
    with pytest.raises(ctypes.ArgumentError):
        library.compiled(is_long)(np.zeros(1, np.dtype(Item)))


def arrays():
    """Arguments of ``sums`` as NumPy has them, with the sum 3·(1 + 2 + 3 + 4 + 5)."""
    items = np.zeros(3, np.dtype(Item))
    items["length_m"] = 5.0
    kinds = ((1, np.float64), (2, np.int32), (3, np.int64), (4, np.uint8))
    return [*(np.full(3, value, kind) for value, kind in kinds), items]


def test_arrays_are_those_of_numpy_and_ctypes_and_bytes(folder):
    called, given = library.compiled(sums), arrays()
    assert called(*given, 3) == 45.0
    given[0].flags.writeable = False
    assert called(*given[:3], bytes([4, 4, 4]), *given[4:], 3) == 45.0
    made = [(kind * 3)() for kind in (ctypes.c_double, ctypes.c_int32, ctypes.c_int64, ctypes.c_uint8, Item)]
    for target, values in zip(made, arrays(), strict=True):
        view(target)[:] = values
    assert called(*made, 3) == 45.0


@pytest.mark.parametrize(
    ("place", "wrong", "message"),
    [
        (0, np.zeros(3, np.float32), "elements of float32; they should be of float64"),
        (0, np.zeros(6)[::2], "strides are .16,.; it should be contiguous"),
        (1, np.zeros(3, np.int64), "elements of int64; they should be of int32"),
        (2, (ctypes.c_int32 * 3)(), "is a c_int_Array_3; it should have elements of int64"),
        (0, bytes(24), "is a bytes"),
        (0, [0.0, 0.0, 0.0], "is a list"),
        (3, 4096, "is a int"),
        (4, np.zeros(3), "elements of float64"),
    ],
)
def test_arrays_of_other_elements_are_refused(folder, place, wrong, message):
    given = arrays()
    given[place] = wrong
    with pytest.raises(ctypes.ArgumentError, match=message):
        library.compiled(sums)(*given, 3)


def test_a_library_that_is_not_used_is_missing_or_is_of_another_source(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("SKYLESS_UNCOMPILED", "1")
    assert library.compiled(later) is later
    monkeypatch.setattr(library, "FOLDER", tmp_path)
    with pytest.raises(SkylessError, match=r"libskyless_core.so: cannot open.*install Skyless again"):
        library.library(library.CORE)
    for file in folder.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "skyless_core.h").write_text("/* changed */\n")
    with pytest.raises(SkylessError, match=r"made from another skyless_core.c .*install Skyless again.*scripts/core"):
        library.library(library.CORE)


def test_that_of_this_checkout_is_made_from_its_source():
    """In a process of its own: this one may run uncompiled."""
    program = "from skyless.core.native.library import library; print(library('skyless_core')._name)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()).parent == NATIVE
