"""Beacons over the whole range of every field, on the grid of what the wire can say."""

from hypothesis import strategies as st

from skyless.core.air.almanac import AccuracyPage, AnchorPage, GeoreferencePage, NoisePage, SchedulePage
from skyless.core.air.frame import Heard
from skyless.core.air.site_pages import MAX_NOISE, MAX_SUPERFRAME_TICKS
from skyless.core.protocol1.beacon import Beacon, MasterTime, heard_capacity


def unsigned(bits):
    return st.integers(0, (1 << bits) - 1)


def on_grid(low, high, steps_per_unit):
    return st.integers(low * steps_per_unit, high * steps_per_unit).map(lambda step: step / steps_per_unit)


coordinates_m = on_grid(-1_000_000, 1_000_000, 1000)

anchor_pages = st.builds(AnchorPage, unsigned(16), coordinates_m, coordinates_m, coordinates_m, unsigned(8))
noises = st.floats(0.0, MAX_NOISE, width=32)
noise_pages = st.builds(NoisePage, noises, noises, noises, noises)
georeference_pages = st.builds(
    GeoreferencePage,
    on_grid(-90, 90, 10**7),
    on_grid(-180, 180, 10**7),
    coordinates_m,
    st.integers(0, 3_599_999_999).map(lambda step: step / 1e7),
)
stds_m = unsigned(16).map(lambda step: step / 10_000)
accuracy_pages = st.builds(
    AccuracyPage,
    stds_m,
    stds_m,
    stds_m,
    stds_m,
    st.integers(1, 0xFFFF).map(lambda step: step / 100),
    st.integers(1, 0xFFFF).map(lambda step: step / 10),
)


@st.composite
def schedule_pages(draw):
    slots = draw(st.integers(1, 255))
    slot_ticks = draw(st.integers(1, min(2**32 - 1, MAX_SUPERFRAME_TICKS // slots)))
    frames_per_node = draw(st.integers(1, slots))
    anchors = draw(st.integers(1, slots // frames_per_node))
    height_m = draw(st.none() | coordinates_m)
    return SchedulePage(slot_ticks, slots, frames_per_node, draw(unsigned(16)), anchors, height_m)


pages = st.one_of(anchor_pages, schedule_pages(), noise_pages, georeference_pages, accuracy_pages)
master_times = st.builds(MasterTime, unsigned(48), unsigned(16).map(lambda step: step / 64))


@st.composite
def beacons(draw):
    master_time, page = draw(st.none() | master_times), draw(st.none() | pages)
    ids = draw(st.lists(unsigned(16), min_size=2, max_size=12, unique=True))
    anchor, master, *others = ids
    master_heard = draw(st.none() | st.builds(Heard, st.just(master), unsigned(8), unsigned(40)))
    if draw(st.booleans()):
        master, master_heard = anchor, None
    fit = heard_capacity(master_heard is not None, master_time is not None, page is not None)
    heard = tuple(Heard(other, draw(unsigned(8)), draw(unsigned(40))) for other in others[:fit])
    return Beacon(
        site=draw(unsigned(16)),
        anchor=anchor,
        sequence=draw(unsigned(8)),
        superframe=draw(unsigned(32)),
        slot=draw(unsigned(8)),
        tx_ticks=draw(unsigned(40)),
        almanac_issue=draw(unsigned(8)),
        master=master,
        term=draw(unsigned(8)),
        master_heard=master_heard,
        master_time=master_time,
        heard=heard,
        page=page,
    )


FULL = Beacon(
    site=42,
    anchor=3,
    sequence=200,
    superframe=1_000_000,
    slot=2,
    tx_ticks=0xAB_CDEF_0123,
    almanac_issue=119,
    master=1,
    term=254,
    master_heard=Heard(1, 198, 0xAB_BDEE_FEDC),
    master_time=MasterTime(0x1234_5678_9ABC, 3.5),
    heard=(Heard(2, 199, 0xAB_C5EF_0001), Heard(6, 41, 7), Heard(5, 40, 8), Heard(4, 39, 9)),
    page=AnchorPage(4, 6.0, 4.125, 2.5, 3),
)
"""A beacon with every part."""
