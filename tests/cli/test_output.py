"""JSON for programs and files all at once."""

import json
import math
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Struct

import skyless
from skyless.cli.common import print_json, to_json

pytestmark = pytest.mark.site


class Colour(StrEnum):
    RED = "red"


class Inner(Struct):
    position_m: np.ndarray


@dataclass
class Outer:
    inner: Inner
    path: Path


def test_numpy_and_others():
    value = {
        "float": np.float64(0.25),
        "single": np.float32(0.5),
        "int": np.int64(2**62),
        "bool": np.bool_(True),
        "matrix": np.eye(2),
        "bad": [math.nan, math.inf, -math.inf, np.float64("nan"), np.array([np.nan, 1.0])],
        "enum": Colour.RED,
        "outer": Outer(Inner(np.zeros(3)), Path("a/b")),
        "tuple": (1, None),
    }
    assert json.loads(to_json(value)) == {
        "float": 0.25,
        "single": 0.5,
        "int": 2**62,
        "bool": True,
        "matrix": [[1.0, 0.0], [0.0, 1.0]],
        "bad": [None, None, None, None, [None, 1.0]],
        "enum": "red",
        "outer": {"inner": {"position_m": [0.0, 0.0, 0.0]}, "path": "a/b"},
        "tuple": [1, None],
    }


@given(st.recursive(st.none() | st.text() | st.floats(allow_nan=False, allow_infinity=False), st.lists))
def test_one_line_that_reads_back(value):
    text = to_json({"value": value})
    assert "\n" not in text
    assert json.loads(text) == {"value": value}


def test_what_has_no_form_is_refused():
    with pytest.raises(TypeError, match="object has no form in JSON"):
        to_json(object())


def test_print_json(capsys):
    print_json({"rmse_m": math.nan})
    assert capsys.readouterr().out == f'{{"skyless_version":"{skyless.__version__}","rmse_m":null}}\n'
