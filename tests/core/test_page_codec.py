import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from protocol1_strategies import pages

from skyless.core.air.almanac import AccuracyPage, AnchorPage, GeoreferencePage, NoisePage, SchedulePage
from skyless.core.air.frame import Malformed
from skyless.core.air.site_pages import decode_page, encode_page

metres = st.floats(-1e6, 1e6)
EARTH_RADIUS_M = 6_378_137.0


@pytest.mark.site
@given(pages)
@settings(max_examples=500)
def test_round_trip(page):
    data = encode_page(page)
    assert len(data) == 17
    assert decode_page(data) == page


@pytest.mark.site
@given(metres, metres, metres)
def test_coordinates_keep_the_millimetre(x_m, y_m, z_m):
    page = decode_page(encode_page(AnchorPage(7, x_m, y_m, z_m, 0)))
    for sent, meant in ((page.x_m, x_m), (page.y_m, y_m), (page.z_m, z_m)):
        assert abs(sent - meant) <= 0.5e-3 + 1e-9


@given(st.floats(-90.0, 90.0), st.floats(-180.0, 180.0), metres, st.floats(0.0, 360.0))
def test_georeference_keeps_the_centimetre(latitude_deg, longitude_deg, height_m, heading_deg):
    page = decode_page(encode_page(GeoreferencePage(latitude_deg, longitude_deg, height_m, heading_deg)))
    north_m = math.radians(page.latitude_deg - latitude_deg) * EARTH_RADIUS_M
    east_m = math.radians(page.longitude_deg - longitude_deg) * EARTH_RADIUS_M
    assert math.hypot(north_m, east_m) < 0.01
    assert abs(page.height_m - height_m) <= 0.5e-3 + 1e-9
    turn_deg = (page.heading_deg - heading_deg + 180.0) % 360.0 - 180.0
    assert abs(turn_deg) <= 0.6e-7


@given(st.tuples(*[st.floats(0.0, 2.0**-19)] * 4))
def test_noise_is_a_float32(figures):
    page = decode_page(encode_page(NoisePage(*figures)))
    sent = (page.tx_stamp_s, page.rx_stamp_s, page.white_fm, page.random_walk_fm)
    assert sent == struct.unpack("<ffff", struct.pack("<ffff", *figures))


@given(*[st.floats(0.0, 6.5)] * 4, st.floats(0.0, 650.0), st.floats(0.0, 6000.0))
def test_accuracy_keeps_its_steps(survey_m, range_m, slope_m, place_m, distance_m, time_s):
    page = decode_page(encode_page(AccuracyPage(survey_m, range_m, slope_m, place_m, distance_m, time_s)))
    sent_m = (page.survey_std_m, page.range_std_m, page.slope_std_m, page.place_std_m)
    assert sent_m == pytest.approx((survey_m, range_m, slope_m, place_m), abs=0.5e-4 + 1e-12)
    assert page.place_distance_m == pytest.approx(max(distance_m, 0.01), abs=0.5e-2 + 1e-9)
    assert page.place_time_s == pytest.approx(max(time_s, 0.1), abs=0.05 + 1e-9)


def test_bytes_of_accuracy():
    """The table in docs/protocol.md."""
    page = AccuracyPage(0.0201, 0.0302, 0.05, 6.5535, 1.23, 100.4)
    data = encode_page(page)
    assert data == bytes.fromhex("05 c900 2e01 f401 ffff 7b00 ec03 00000000")
    assert decode_page(data[:13] + b"\1\2\3\4") == page  # reserved bytes are not looked at


@pytest.mark.parametrize(
    ("page", "named"),
    [
        (AnchorPage(65536, 0.0, 0.0, 0.0, 0), "AnchorPage.anchor is 65536"),
        (AnchorPage(1, 0.0, 1_000_001.0, 0.0, 0), "AnchorPage.y_m is 1000001.0"),
        (AnchorPage(1, 0.0, 0.0, math.nan, 0), "AnchorPage.z_m is nan"),
        (AnchorPage(1, 0.0, 0.0, 0.0, 256), "AnchorPage.slot is 256"),
        (SchedulePage(0, 7, 1, 1, 7, None), "SchedulePage.slot_ticks is 0"),
        (SchedulePage(2**32, 7, 1, 1, 7, None), "SchedulePage.slot_ticks is 4294967296"),
        (SchedulePage(2155905153, 255, 1, 1, 7, None), "SchedulePage.slot_ticks is 2155905153; .* to 2155905152"),
        (SchedulePage(2**27, 0, 1, 1, 7, None), "SchedulePage.slots is 0"),
        (SchedulePage(2**27, 256, 1, 1, 7, None), "SchedulePage.slots is 256"),
        (SchedulePage(2**27, 7, 0, 1, 7, None), "SchedulePage.frames_per_node is 0"),
        (SchedulePage(2**27, 7, 2, 1, 7, None), "SchedulePage.anchors is 7; .* to 3"),
        (SchedulePage(2**27, 7, 1, -1, 7, None), "SchedulePage.master is -1"),
        (SchedulePage(2**27, 7, 1, 1, 7, math.inf), "SchedulePage.tag_height_m is inf"),
        (NoisePage(1e-3, 0.0, 0.0, 0.0), "NoisePage.tx_stamp_s is 0.001"),
        (NoisePage(0.0, -1e-12, 0.0, 0.0), "NoisePage.rx_stamp_s is -1e-12"),
        (NoisePage(0.0, 0.0, 0.0, 0.1), "NoisePage.random_walk_fm is 0.1"),
        (AccuracyPage(-1e-3, 0.0, 0.0, 0.0, 1.0, 1.0), "AccuracyPage.survey_std_m is -0.001"),
        (AccuracyPage(0.0, 6.6, 0.0, 0.0, 1.0, 1.0), "AccuracyPage.range_std_m is 6.6; .* to 6.5535"),
        (AccuracyPage(0.0, 0.0, math.inf, 0.0, 1.0, 1.0), "AccuracyPage.slope_std_m is inf"),
        (AccuracyPage(0.0, 0.0, 0.0, math.nan, 1.0, 1.0), "AccuracyPage.place_std_m is nan"),
        (AccuracyPage(0.0, 0.0, 0.0, 0.0, 655.4, 1.0), "AccuracyPage.place_distance_m is 655.4; .* to 655.35"),
        (AccuracyPage(0.0, 0.0, 0.0, 0.0, 1.0, 6554.0), "AccuracyPage.place_time_s is 6554.0; .* to 6553.5"),
        (GeoreferencePage(90.1, 0.0, 0.0, 0.0), "GeoreferencePage.latitude_deg is 90.1"),
        (GeoreferencePage(0.0, -180.5, 0.0, 0.0), "GeoreferencePage.longitude_deg is -180.5"),
        (GeoreferencePage(0.0, 0.0, 0.0, -1.0), "GeoreferencePage.heading_deg is -1.0"),
    ],
)
def test_errors_name_the_field(page, named):
    with pytest.raises(ValueError, match=named):
        encode_page(page)


@pytest.mark.parametrize(
    ("layout", "values"),
    [
        ("<BHiiiBx", (1, 5, 1_000_000_001, 0, 0, 0)),
        ("<BHiiiBx", (1, 5, 0, 0, -(2**31), 0)),
        ("<BIBBHBBixx", (2, 0, 7, 1, 1, 7, 0, 0)),
        ("<BIBBHBBixx", (2, 2**27, 0, 1, 1, 7, 0, 0)),
        ("<BIBBHBBixx", (2, 2**27, 7, 0, 1, 7, 0, 0)),
        ("<BIBBHBBixx", (2, 2**27, 7, 1, 1, 0, 0, 0)),
        ("<BIBBHBBixx", (2, 2**27, 7, 1, 1, 8, 0, 0)),
        ("<BIBBHBBixx", (2, 2**32 - 1, 255, 1, 1, 7, 0, 0)),
        ("<BIBBHBBixx", (2, 2**27, 7, 1, 1, 7, 1, -(2**31))),
        ("<Bffff", (3, math.nan, 0.0, 0.0, 0.0)),
        ("<Bffff", (3, 0.0, math.inf, 0.0, 0.0)),
        ("<Bffff", (3, 0.0, 0.0, -1e-30, 0.0)),
        ("<Bffff", (3, 0.0, 0.0, 0.0, 1.0)),
        ("<BiiiI", (4, 900_000_001, 0, 0, 0)),
        ("<BiiiI", (4, 0, -1_800_000_001, 0, 0)),
        ("<BiiiI", (4, 0, 0, 1_000_000_001, 0)),
        ("<BiiiI", (4, 0, 0, 0, 3_600_000_000)),
        ("<BHHHHHH4x", (5, 200, 300, 500, 300, 0, 1000)),
        ("<BHHHHHH4x", (5, 200, 300, 500, 300, 100, 0)),
    ],
)
def test_absurd_pages_are_bad(layout, values):
    assert decode_page(struct.pack(layout, *values)) is Malformed.BAD_PAGE


@given(st.binary(min_size=17, max_size=17))
def test_what_decodes_encodes_again(data):
    page = decode_page(data)
    if page is not None and page is not Malformed.BAD_PAGE:
        assert decode_page(encode_page(page)) == page


@pytest.mark.parametrize("kind", [0, 8, 255])
def test_unknown_types_are_not_errors(kind):
    assert decode_page(bytes((kind,)) + bytes(16)) is None
