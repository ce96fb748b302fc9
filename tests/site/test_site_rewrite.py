"""Antenna delays into the text of a site file."""

import tomllib

import pytest

from skyless.core.errors import ConfigurationError
from skyless.core.site import AccuracySite
from skyless.sim.lab import lab_site
from skyless.site.file.load import load_site, with_values
from skyless.site.file.template import site_template

TEXT = """\
name = "hall"   # ours
id = 7

[[anchors]]     # by the door
id = 1  # the master
x_m = 0.0
  tx_antenna_delay_ticks = 16_500  # measured in May
y_m = 0.0

# the far one
[[ anchors ]]
id = 2
x_m = 6.0
y_m = 1.0    # taped

[tags]
height_m = 1.2
"""


def with_tx_delays(text, delays_ticks, path):
    of_anchors = {anchor: {"tx_antenna_delay_ticks": ticks} for anchor, ticks in delays_ticks.items()}
    return with_values(text, of_anchors, {}, path, "the delays")


def test_values_change_where_they_stand_and_are_added_where_they_do_not():
    changed = with_tx_delays(TEXT, {1: 16510, 2: 16400}, "site.toml")
    assert changed == TEXT.replace("16_500", "16510").replace("# taped\n", "# taped\ntx_antenna_delay_ticks = 16400\n")
    assert with_tx_delays(changed, {1: 16510, 2: 16400}, "site.toml") == changed


def test_anchors_that_are_not_named_stay():
    assert with_tx_delays(TEXT, {}, "site.toml") == TEXT
    assert with_tx_delays(TEXT, {99: 1}, "site.toml") == TEXT


def test_line_ends_stay():
    crlf = TEXT.replace("\n", "\r\n")
    changed = with_tx_delays(crlf, {2: 16400}, "site.toml")
    assert changed.replace("\r\n", "") == crlf.replace("\r\n", "").replace(
        "# taped", "# tapedtx_antenna_delay_ticks = 16400"
    )
    assert "\n" not in changed.replace("\r\n", "")


def test_a_last_line_without_its_end():
    text = 'name="a"\nid=1\n[[anchors]]\nid = 3\nx_m = 1.0'
    assert tomllib.loads(with_tx_delays(text, {3: 5}, "s"))["anchors"] == [
        {"id": 3, "x_m": 1.0, "tx_antenna_delay_ticks": 5}
    ]


def test_a_template_stays_a_valid_site(tmp_path):
    path = tmp_path / "lab.toml"
    site = lab_site(accuracy=AccuracySite(survey_std_m=0.004, place_time_s=30.0))
    delays = {anchor.id: 16400 + anchor.id for anchor in site.anchors}
    path.write_text(with_tx_delays(site_template(site), delays, path))
    assert load_site(path).accuracy == site.accuracy
    assert {anchor.id: anchor.tx_antenna_delay_ticks for anchor in load_site(path).anchors} == delays


@pytest.mark.parametrize(
    "text",
    ['anchors = [{id = 1, x_m = 0.0, y_m = 0.0}]\n', '[[anchors]]\n"id" = 1\nx_m = 0.0\n',
     '[[anchors]]\nid = 1\nnote = """\n[[anchors]]\nid = 1\n"""\n'],
)  # fmt: skip
def test_what_cannot_be_followed_is_refused_and_not_guessed(text):
    with pytest.raises(ConfigurationError, match="one line for each key"):
        with_tx_delays(text, {1: 5}, "site.toml")
