"""Beacons of protocol 2 over the whole range of every field, on the grid of what the wire can say."""

from hypothesis import strategies as st
from protocol1_strategies import accuracy_pages, coordinates_m, georeference_pages, noise_pages, unsigned

from skyless.core.air.almanac import LONGEST_PERIOD_CODE, KeyPage, SitePage
from skyless.core.air.beacon import Authentication, Beacon, StatedPosition, heard_capacity
from skyless.core.air.frame import Heard


def signed_steps(bits, steps_per_unit):
    most = (1 << bits - 1) - 1
    return st.integers(-most, most).map(lambda step: step / steps_per_unit)


stated_m = signed_steps(24, 1000)
positions = st.builds(
    StatedPosition,
    stated_m, stated_m, stated_m, unsigned(8).map(lambda step: step / 1000), st.integers(-128, 127), unsigned(8),
)  # fmt: skip
site_pages = st.builds(SitePage, st.integers(1, 255), st.none() | coordinates_m)
pages = st.one_of(
    st.builds(KeyPage, st.binary(min_size=16, max_size=16)), site_pages, noise_pages, georeference_pages, accuracy_pages
)


phases = st.none() | st.integers(0, 127).map(lambda step: step / 128)


@st.composite
def beacons(draw):
    certificate = draw(st.none() | st.binary(min_size=94, max_size=94))
    has_phases = certificate is None and draw(st.booleans())
    position = page = None
    if certificate is None:
        position, page = draw(st.none() | positions), draw(st.none() | pages)
    fit = heard_capacity(position=position is not None, page=page is not None, certificate=certificate is not None)
    anchor, *others = draw(st.lists(unsigned(16), min_size=1, max_size=1 + fit, unique=True))
    return Beacon(
        site=draw(unsigned(16)),
        anchor=anchor,
        sequence=draw(unsigned(8)),
        tx_ticks=draw(unsigned(40)),
        almanac_issue=draw(unsigned(16)),
        period_code=draw(st.integers(0, LONGEST_PERIOD_CODE)),
        position=position,
        heard=tuple(
            Heard(other, draw(unsigned(8)), draw(unsigned(32)), draw(phases), is_short=True)
            if has_phases
            else Heard(other, draw(unsigned(8)), draw(unsigned(40)))
            for other in others
        ),
        weak=draw(st.integers(0, (1 << len(others)) - 1)),
        page=page,
        certificate=certificate,
        authentication=draw(st.none() | st.builds(Authentication, unsigned(16), st.binary(min_size=8, max_size=8))),
        has_phases=has_phases,
    )


FULL = Beacon(
    site=42,
    anchor=3000,
    sequence=200,
    tx_ticks=0xAB_CDEF_0123,
    almanac_issue=0x7719,
    period_code=0x1E,
    position=StatedPosition(-1006.0, 4004.125, 2.5, 0.02, -1, 7),
    heard=(Heard(2, 199, 0xAB_C5EF_0001), Heard(6, 41, 7), Heard(5, 40, 8), Heard(4, 39, 9)),
    weak=0b0010,
    page=SitePage(4, 1.2),
)
"""A beacon with every part that goes with others."""
