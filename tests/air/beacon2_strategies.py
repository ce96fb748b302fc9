"""Beacons of protocol 2 over the whole range of every field, on the grid of what the wire can say."""

from beacon_strategies import accuracy_pages, coordinates_m, georeference_pages, noise_pages, unsigned
from hypothesis import strategies as st

from skyless.air.almanac import KeyPage, SitePage
from skyless.air.beacon import Heard
from skyless.air.beacon2 import Authentication, Beacon2, SlotTime, StatedPosition, StatedSiteTime
from skyless.air.codec2 import heard_capacity_2
from skyless.air.page_codec import MAX_SUPERFRAME_TICKS


def signed_steps(bits, steps_per_unit):
    most = (1 << bits - 1) - 1
    return st.integers(-most, most).map(lambda step: step / steps_per_unit)


slot_times = st.builds(
    SlotTime,
    unsigned(32), unsigned(8), unsigned(16), unsigned(32), unsigned(8), unsigned(8), signed_steps(24, 2.0**36),
)  # fmt: skip
stated_m = signed_steps(24, 1000)
positions = st.builds(
    StatedPosition,
    stated_m, stated_m, stated_m, unsigned(8).map(lambda step: step / 1000), st.integers(-128, 127), unsigned(8),
)  # fmt: skip
site_times = st.builds(StatedSiteTime, signed_steps(24, 256), unsigned(16).map(lambda step: step / 64))


site_pages = st.builds(
    SitePage, st.integers(1, 255), st.integers(1, MAX_SUPERFRAME_TICKS), unsigned(8), st.none() | coordinates_m
)
pages = st.one_of(
    st.builds(KeyPage, st.binary(min_size=16, max_size=16)), site_pages, noise_pages, georeference_pages, accuracy_pages
)


@st.composite
def beacons2(draw):
    certificate = draw(st.none() | st.binary(min_size=94, max_size=94))
    slot_time = position = page = None
    if certificate is None:
        slot_time, position, page = draw(st.none() | slot_times), draw(st.none() | positions), draw(st.none() | pages)
    site_time = None if slot_time is None else draw(st.none() | site_times)
    fit = heard_capacity_2(
        slot_time=slot_time is not None,
        position=position is not None,
        site_time=site_time is not None,
        page=page is not None,
        certificate=certificate is not None,
    )
    anchor, *others = draw(st.lists(unsigned(16), min_size=1, max_size=1 + fit, unique=True))
    return Beacon2(
        site=draw(unsigned(16)),
        anchor=anchor,
        sequence=draw(unsigned(8)),
        tx_ticks=draw(unsigned(40)),
        almanac_issue=draw(unsigned(16)),
        slot_time=slot_time,
        position=position,
        site_time=site_time,
        heard=tuple(Heard(other, draw(unsigned(8)), draw(unsigned(40))) for other in others),
        weak=draw(st.integers(0, (1 << len(others)) - 1)),
        page=page,
        certificate=certificate,
        authentication=draw(st.none() | st.builds(Authentication, unsigned(16), st.binary(min_size=8, max_size=8))),
    )


FULL_2 = Beacon2(
    site=42,
    anchor=3000,
    sequence=200,
    tx_ticks=0xAB_CDEF_0123,
    almanac_issue=0x7719,
    slot_time=SlotTime(1_000_000, 12, 17, 70_000, 5, 6, 10e-6),
    position=StatedPosition(-1006.0, 4004.125, 2.5, 0.02, -1, 7),
    site_time=StatedSiteTime(-256.5, 3.5),
    heard=(Heard(2, 199, 0xAB_C5EF_0001), Heard(6, 41, 7), Heard(5, 40, 8), Heard(4, 39, 9)),
    weak=0b0010,
    page=SitePage(4, 38 << 26, 38, 1.2),
)
"""A beacon with every part; its rate is not on the grid of the wire."""
