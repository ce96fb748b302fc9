"""Sites and fixes for tests of bridges."""

from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.bridges.target import BridgedSite
from skyless.core.site import GeoreferenceSite
from skyless.run.mqtt.messages import FixMessage
from support.site_messages import diagonal

BERLIN = GeoreferenceSite(latitude_deg=52.512345678, longitude_deg=13.326, height_m=34.5, heading_deg=30.0)
SITE = BridgedSite(7, "hall", True, {1: (0.0, 0.0, 2.5), 2: (6.0, 0.0, 2.5)}, BERLIN)
BARE_SITE = BridgedSite(7, "hall", True, {1: (0.0, 0.0, 2.5)}, None)


FIX = FixMessage(
    "tag1", 1, 1_795_000_000.25, 12.0, (1.0, 2.0, 1.5), (0.0025, 0.001, 0.0, 0.001, 0.0036, 0.0005, 0.0, 0.0005, 0.01),
    (0.5, -0.25, 0.125), diagonal(0.01, 0.02, 0.03), 0.13, 3.0, 2.5, 1.5, 2.0, (1, 2, 3, 4, 5, 6), 3.0, 3, 0.03,
    "joint", False, 0.004,
)  # fmt: skip


def a_fix(**changes):
    return replace(FIX, **changes)


_metres = st.floats(-8000.0, 8000.0)
_entries = st.floats(-1.0, 1.0)


@st.composite
def covariances(draw):
    """L Lᵀ with a lower triangular L: symmetric, and at least positive semidefinite."""
    a, b, c, d, e, f = (draw(_entries) for _ in range(6))
    xx, xy, xz = a * a, a * b, a * d
    yy, yz, zz = b * b + c * c, b * d + c * e, d * d + e * e + f * f
    return xx, xy, xz, xy, yy, yz, xz, yz, zz


@st.composite
def fixes(draw):
    """Any usable fix, with and without velocity and dilutions."""
    moving = draw(st.booleans())
    dilution = st.none() | st.floats(0.5, 90.0)
    return a_fix(
        tag=draw(st.sampled_from(("tag1", "tag2", "drone"))),
        serial=draw(st.integers(1, 2**40)),
        unix_s=draw(st.floats(0.0, 4e9)),
        position_m=draw(st.tuples(_metres, _metres, _metres)),
        covariance_m2=draw(covariances()),
        velocity_mps=draw(st.tuples(*[st.floats(-50.0, 50.0)] * 3)) if moving else None,
        velocity_covariance=draw(covariances()) if moving else None,
        hdop=draw(dilution),
        vdop=draw(dilution),
        anchors=tuple(range(draw(st.integers(3, 40)))),
        height_known=draw(st.booleans()),
    )


georeferences = st.builds(
    GeoreferenceSite,
    latitude_deg=st.floats(-89.0, 89.0),
    longitude_deg=st.floats(-180.0, 180.0),
    height_m=st.floats(-400.0, 8000.0),
    heading_deg=st.floats(-360.0, 360.0),
)
