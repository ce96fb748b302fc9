"""Messages of a site's programs. Each is complete; a test states the fields that matter to it."""

from msgspec.structs import replace

from skyless.run.mqtt.messages import AnchorHealth, Counters, FixMessage, TagHealth

MQTT = Counters(0, 0, 0)


def diagonal(xx, yy, zz=0.0):
    """A covariance without correlation."""
    return (xx, 0.0, 0.0, 0.0, yy, 0.0, 0.0, 0.0, zz)


FIX = FixMessage(
    *("t1", 1, 1000.0, 1000.0, (2.0, 2.0, 1.0), diagonal(1e-4, 1e-4), None, None, 0.01, 1.0, 1.0, 1.0, None),
    *((1, 2, 3, 4), 2.5, 3, 0.01, "joint", True, 0.001),
)
TAG = TagHealth("t1", 1000.0, 60.0, "joint", 400, 390, 400.0, None, 0.1, 1e-3, 2e-3, {}, MQTT, 0.1, 1, ())
ANCHOR = AnchorHealth(1, 1000.0, 60.0, "anchor", 1, 0, True, 0.1, 0.5, 0.01, 9, 0, 9, 7, {}, {}, MQTT)


def a_fix(tag="t1", **fields):
    """A fix."""
    return replace(FIX, tag=tag, **fields)


def tag_health(tag="t1", **fields):
    """The health of a tag."""
    return replace(TAG, tag=tag, **fields)


def anchor_health(anchor=1, **fields):
    """The health of an anchor."""
    return replace(ANCHOR, anchor=anchor, **fields)
