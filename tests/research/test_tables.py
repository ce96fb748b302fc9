import gzip
import io
import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.core.air.masterless_packets import PairTdoa
from skyless.core.errors import ConfigurationError
from skyless.research.foreign.datasets import read_tdoas
from skyless.research.foreign.formats import format_of
from skyless.site.tables import read_anchors, read_truth

HEADER = b"t_s,idA,idB,tdoa_m\n"


def tdoas(table):
    drops = Counter()
    return list(read_tdoas(io.BytesIO(table), drops)), drops


def test_the_names_of_columns_are_ours_or_those_of_the_flights_in_any_order():
    expected = [PairTdoa(0.5, 1, 2, -0.25)]
    for table in (
        b"t_s,anchor_a,anchor_b,tdoa_m\n0.5,1,2,-0.25\n",
        b"anchor_b,more,t_s,tdoa_m,idA\n2,x,0.5,-0.25,1\n",
        b"tdoa_m,snr,t_s,idB,idA\r\n-0.25,9,0.5,2,1\r\n",
    ):
        assert tdoas(table) == (expected, {})


def test_a_table_without_a_column_is_refused_with_the_names_that_are_missing(tmp_path):
    file = tmp_path / "mine.csv"
    file.write_text("t_s,anchor_a,anchor_b,tdoa_m\n0.5,1,2,-0.25\n")
    assert format_of(file).name == "tdoa-table"
    file.write_text("t_s,anchor_a,to,tdoa\n0.5,1,2,-0.25\n")
    with pytest.raises(ConfigurationError, match=r"the header is .t_s,.*\(missing: anchor_b, tdoa_m\)"):
        format_of(file)


def test_a_table_with_all_kinds_of_bad_lines():
    table = (
        HEADER
        + b"0.5,1,2,-0.25\n"
        + HEADER
        + b"1,1,2,nan\n2,1,,3\n3,1,2\n4,1,2,3,4\n5,x,2,3\n\n6,3,3,1\n7,4,5,1e0\n8,1,2,1"
    )
    values, drops = tdoas(table)
    assert values == [PairTdoa(0.5, 1, 2, -0.25), PairTdoa(7.0, 4, 5, 1.0)]
    assert drops == {
        "repeated-header": 1,
        "not-finite": 1,
        "blank-field": 1,
        "wrong-number-of-columns": 2,
        "malformed-number": 1,
        "blank-line": 1,
        "anchor-against-itself": 1,
        "unfinished-line": 1,
    }


@given(st.binary(max_size=2000))
def test_random_tables_never_raise(noise):
    values, _ = tdoas(HEADER + noise)
    assert all(math.isfinite(value.tdoa_m) for value in values)


def write(folder, text):
    file = folder / "table.csv"
    file.write_text(text)
    return file


def test_anchors_with_other_columns_and_hexadecimal_identifiers(tmp_path):
    file = write(tmp_path, "name,id,z_m,y_m,x_m\nfirst,1,0.5,2,3\n\nsecond,0x90000A05B,1,1,1")
    assert read_anchors(file) == {1: (3.0, 2.0, 0.5), 0x90000A05B: (1.0, 1.0, 1.0)}


def test_truth_with_and_without_attitude(tmp_path):
    truth = read_truth(write(tmp_path, "t_s,x_m,y_m,z_m,qx,qy,qz,qw\n0,1,2,3,0,0,0,1\n1,2,3,4,0,0,1,0\n"))
    np.testing.assert_array_equal(truth.position_m, [[1, 2, 3], [2, 3, 4]])
    np.testing.assert_array_equal(truth.quaternion, [[0, 0, 0, 1], [0, 0, 1, 0]])
    assert read_truth(write(tmp_path, "t_s,x_m,y_m,z_m\n0,1,2,3\n")).quaternion is None


@pytest.mark.parametrize(
    ("read", "text", "named"),
    [
        (read_anchors, "", "line 1"),
        (read_anchors, "id,x_m,y_m\n1,2,3\n", "line 1"),
        (read_anchors, "id,x_m,y_m,z_m\n", "the table"),
        (read_anchors, "id,x_m,y_m,z_m\n1,2,3\n", "line 2"),
        (read_anchors, "id,x_m,y_m,z_m\n1,2,3,4\n2,2,three,4\n", "line 3, column y_m"),
        (read_anchors, "id,x_m,y_m,z_m\n1,2,3,nan\n", "line 2, column z_m"),
        (read_anchors, "id,x_m,y_m,z_m\nA,2,3,4\n", "line 2, column id"),
        (read_anchors, "id,x_m,y_m,z_m\n1,2,3,4\n1,2,3,4\n", "line 3, column id"),
        (read_truth, "a,b\n1,2\n", "line 1"),
        (read_truth, "t_s,x_m,y_m,z_m\n", "the table"),
        (read_truth, "t_s,x_m,y_m,z_m\n0,1,2\n", "line 2"),
        (read_truth, "t_s,x_m,y_m,z_m\n0,1,2,inf\n", "line 2, column z_m"),
        (read_truth, "t_s,x_m,y_m,z_m\n1,1,2,3\n0.5,1,2,3\n", "column t_s"),
    ],
)
def test_bad_tables_are_named(tmp_path, read, text, named):
    file = write(tmp_path, text)
    with pytest.raises(ConfigurationError) as caught:
        read(file)
    assert caught.value.key == named
    assert str(file) in str(caught.value)


def test_truth_in_a_broken_archive_is_an_error(tmp_path):
    file = tmp_path / "truth.csv.gz"
    file.write_bytes(gzip.compress(b"t_s,x_m,y_m,z_m\n" + b"0,1,2,3\n" * 1000)[:-20])
    with pytest.raises(ConfigurationError, match="whole file"):
        read_truth(file)


def test_damaged_rows_of_a_recording_that_has_its_own_truth_are_left_out(tmp_path):
    names = "t_s,listener,gt_L_x_m,gt_L_y_m,gt_L_z_m"
    good = [f"{k / 10},7,{k},2,3" for k in range(6)]
    damaged = [
        "0.25,7,nan,2,3",
        "0.25,7,1e300,2,3",
        "0.25,7,x,2,3",
        "0.2",
        "\N{REPLACEMENT CHARACTER},7,1,2,3",
        "0.3,7,1,2,3,4,5",
    ]
    truth = read_truth(write(tmp_path, "\n".join([names, *good[:3], *damaged, good[4], good[3], good[5]])))
    assert truth.t_s.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert truth.position_m[:, 0].tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
