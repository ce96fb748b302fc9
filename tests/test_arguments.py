"""Values that programs pass as arguments: what is no such value is named, and texts of commands name arguments."""

import numpy as np
import pytest

from skyless.arguments import as_arguments, check_number, check_point, check_whole
from skyless.core.errors import SkylessError
from skyless.research.replays.options import ReplayOptions


def test_numbers_of_every_library_pass():
    for value in (3, np.int64(3)):
        check_whole("x", value, least=3, most=3)
    for value in (3, 3.0, np.float64(3.0), np.int32(3)):
        check_number("x", value, least=3.0)
    check_point("x", np.array([1.0, 2.0]), (2, 3))
    check_point("x", (1, np.float32(2), 3.0), (2, 3))


@pytest.mark.parametrize("value", [3.0, np.float64(3.0), True, "3", 2, float("nan"), b"3", (3,)])
def test_what_is_no_whole_number_is_refused(value):
    with pytest.raises(SkylessError, match=r"^x is .*; it should be a whole number, at least 3$"):
        check_whole("x", value, least=3)


@pytest.mark.parametrize("value", [10**400, -(10**400), float("inf"), "3", True, 1j, (3,)])
def test_what_is_no_number_is_refused(value):
    with pytest.raises(SkylessError, match=r"^x is .*; it should be a number$"):
        check_number("x", value)


@pytest.mark.parametrize("value", ["12", b"12", ("1", "2"), (1,), (1, 10**400), (1, None), 12, None, {1, 2, 3, 4}])
def test_what_is_no_point_is_refused(value):
    with pytest.raises(SkylessError, match=r"^x is .*; it should be 2 or 3 finite numbers in metres$"):
        check_point("x", value, (2, 3))


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("--tag-height is 'x'; give --site, or (--truth)", "tag_height_m is 'x'; give site, or (truth)"),
        ("/data/run--west/x.csv: no column; --truth", "/data/run--west/x.csv: no column; truth"),
        ("./--west.csv is empty", "./--west.csv is empty"),
        ("a---b", "a---b"),
    ],
)
def test_options_become_arguments_and_paths_stay(text, named):
    assert as_arguments(text, ReplayOptions) == named
