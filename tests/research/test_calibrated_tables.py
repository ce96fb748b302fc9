"""Calibrations in tables of anchors: written back, read again, and refused where they cannot be."""

import pytest

from skyless.core.errors import ConfigurationError
from skyless.site.survey.anchor_errors import AnchorCalibration, DifferenceCalibration
from skyless.site.tables import calibrated_table, new_table, read_anchors, read_calibration

KNOWN = DifferenceCalibration({1: AnchorCalibration(0.1234, 0.08, 0.061), 16: AnchorCalibration(-0.1)})
TABLE = 'name,id,x_m,y_m,z_m\n"door, left",1,0.10,0,2.5000\n\nwindow,0x10,6,0,2\nfar,3,6,8,2\n'


def test_everything_else_stays_as_it_is_written(tmp_path):
    path = tmp_path / "anchors.csv"
    path.write_text(TABLE)
    path.write_text(calibrated_table(path, KNOWN))
    assert path.read_text() == (
        "name,id,x_m,y_m,z_m,bias_m,bias_slope_m,noise_m\n"
        '"door, left",1,0.10,0,2.5000,0.1234,0.0800,0.0610\n'
        "\n"
        "window,0x10,6,0,2,-0.1000,0.0000,\n"
        "far,3,6,8,2,,,\n"
    )
    assert read_calibration(path) == KNOWN
    assert read_anchors(path)[1] == (0.1, 0.0, 2.5)
    assert calibrated_table(path, KNOWN) == path.read_text()


def test_a_table_without_the_column_holds_none(tmp_path):
    path = tmp_path / "anchors.csv"
    path.write_text(TABLE)
    assert read_calibration(path) is None


def test_anchors_that_stood_in_no_table_get_one(tmp_path):
    path = tmp_path / "anchors.csv"
    path.write_text(new_table({16: (1.0, 2.0, 3.0), 1: (0.1, 0.2, 0.3)}, KNOWN))
    assert read_anchors(path) == {1: (0.1, 0.2, 0.3), 16: (1.0, 2.0, 3.0)}
    assert read_calibration(path) == KNOWN


@pytest.mark.parametrize(
    ("field", "message"),
    [("far,,", "column bias_m is \"far\""), ("inf,,", "column bias_m"), ("0,nan,", "column bias_slope_m"),
     ("0,0,-1", "column noise_m is \"-1\"")],
)  # fmt: skip
def test_what_cannot_be_is_named(tmp_path, field, message):
    path = tmp_path / "anchors.csv"
    path.write_text(f"id,x_m,y_m,z_m,bias_m,bias_slope_m,noise_m\n1,0,0,0,{field}\n")
    with pytest.raises(ConfigurationError, match="line 2") as caught:
        read_calibration(path)
    assert message in str(caught.value)
