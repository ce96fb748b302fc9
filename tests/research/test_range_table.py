"""Tables for a survey: ranges, many of each pair, and heights."""

import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.errors import ConfigurationError
from skyless.site.survey.legs import mean_ranges
from skyless.site.tables import read_heights, read_ranges

HEADER = "anchor_a,anchor_b,range_m\n"


def table(tmp_path, text):
    path = tmp_path / "ranges.csv"
    path.write_text(text)
    return path


def test_both_directions_are_one_pair_and_other_columns_are_ignored(tmp_path):
    path = table(tmp_path, "t_s, anchor_b,anchor_a ,range_m\n0,1,2,5.0\n1,2,1,5.2\n\n2,0x10,1,7.5\n")
    ranges = read_ranges(path)
    assert ranges.anchors == (1, 2, 16)
    assert [(pair.a, pair.b, pair.range_m, pair.exchanges) for pair in ranges.pairs] == [
        (1, 2, pytest.approx(5.1), 2),
        (1, 16, 7.5, 1),
    ]
    packed = tmp_path / "ranges.csv.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    assert read_ranges(packed) == ranges


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "line 1"),
        ("a,b,range\n1,2,3\n", "a header with anchor_a,anchor_b,range_m"),
        (HEADER, "at least one range"),
        (HEADER + "1,2\n", "line 2 is"),
        (HEADER + "1,2,3\n1,x,3\n", 'line 3, column anchor_b is "x"'),
        (HEADER + "-1,2,3\n", 'line 2, column anchor_a is "-1"'),
        (HEADER + "4,4,3\n", 'line 2, column anchor_b is "4"; it should be another anchor'),
        (HEADER + "1,2,nan\n", 'column range_m is "nan"'),
        (HEADER + "1,2,1e9\n", 'column range_m is "1e9"; it should be metres'),
        ("anchor_a,anchor_b,range_m,range_m\n1,2,3,4\n", "different names"),
        ("\0" * ((1 << 20) + 1), "lines of text"),
    ],
)
def test_bad_ranges_are_named(tmp_path, text, words):
    path = table(tmp_path, text)
    with pytest.raises(ConfigurationError) as error:
        read_ranges(path)
    assert str(path) in str(error.value)
    assert words in str(error.value)


def test_heights(tmp_path):
    path = table(tmp_path, "id,z_m\n1,2.5\n3,-0.4\n")
    assert read_heights(path) == {1: 2.5, 3: -0.4}
    for text, words in (
        ("id,z_m\n1,2\n1,3\n", "only once"),
        ("id,z_m\n", "at least one height"),
        ("id,z_m\n1,high\n", "a finite number"),
        ("id,z_m\n1,1e300\n", "metres, at most"),
        ("id\n1\n", "a header with id,z_m"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            read_heights(table(tmp_path, text))


def test_the_earliest_cluster_that_is_large_enough():
    draw = np.random.default_rng(5)
    direct, late, one_early = draw.normal(7.0, 0.03, 12), draw.normal(8.1, 0.03, 80), [3.0]
    ranges = mean_ranges({(1, 2): [*late, *direct, *one_early], (1, 3): draw.normal(4.0, 0.03, 25).tolist()})
    first, second = ranges.pairs
    assert first.range_m == pytest.approx(7.0, abs=4 * 0.03 / np.sqrt(12))
    assert first.late_share == pytest.approx(80 / 93)
    assert second.range_m == pytest.approx(4.0, abs=4 * 0.03 / 5)
    assert second.std_m == pytest.approx(0.03 / 5, rel=0.5)
    assert second.late_share == 0.0
    assert ranges.anchors == (1, 2, 3)


def test_few_ranges_have_the_noise_of_the_others():
    draw = np.random.default_rng(6)
    many = {(1, k): draw.normal(5.0, 0.04, 20).tolist() for k in range(2, 12)}
    ranges = mean_ranges({**many, (2, 3): [4.0], (2, 4): [4.0, 4.0], (2, 5): [4.0, 9.0, 4.01]})
    std_m = {(pair.a, pair.b): pair.std_m for pair in ranges.pairs}
    assert std_m[2, 3] == pytest.approx(0.04, rel=0.3)
    assert std_m[2, 4] == pytest.approx(std_m[2, 3] / np.sqrt(2))
    assert next(pair.range_m for pair in ranges.pairs if (pair.a, pair.b) == (2, 5)) == 4.01


@given(st.lists(st.floats(0.0, 50.0), min_size=1, max_size=40))
def test_whatever_the_ranges_the_mean_is_one_of_them(values):
    (pair,) = mean_ranges({(1, 2): values}).pairs
    assert min(values) - 1e-9 <= pair.range_m <= max(values) + 1e-9
    assert 0.0 < pair.std_m < np.inf
    assert 0.0 <= pair.late_share < 1.0
    assert 1 <= pair.exchanges <= len(values)
