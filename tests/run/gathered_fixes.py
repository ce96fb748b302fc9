"""A fix as tags publish it."""

import msgspec
from msgspec.structs import replace

from skyless.run.mqtt.messages import FixMessage

VARIANCE = (1e-4,) * 9
FIX = FixMessage(
    *("a", 1, 1_700_000_000.0, 1.0, (1.0, 2.0, 3.0), VARIANCE, None, None, 0.02, 1.0, 1.0, 1.0, None),
    *((1, 2, 3), 2.5, 3, 0.01, "joint", True, 0.001),
)


def of_tag(tag, x_m=1.0):
    """The fix of a tag."""
    return replace(FIX, tag=tag, position_m=(x_m, 2.0, 3.0))


def payload(tag, x_m=1.0):
    """The same in JSON."""
    return msgspec.json.encode(of_tag(tag, x_m))
