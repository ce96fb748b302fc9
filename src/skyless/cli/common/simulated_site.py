"""What a site needs to be simulated, and which of its anchors then take no part."""

import sys
from typing import TYPE_CHECKING, Final

from skyless.method_names import DEFAULT_METHOD

if TYPE_CHECKING:
    from skyless.site.model import Site

_MOST_LIVE_HZ: Final = 4000.0
"""Beacons per second above which the emulated air is expected to fall behind; two cores kept up with 1000."""


def check_simulated(site: "Site", method: str = DEFAULT_METHOD) -> None:
    """See that tags of a simulated site can have fixes by a method; names anchors left out, on standard error.

    Raises SkylessError.
    """
    from skyless.evaluation.scenarios import check_can_be_simulated

    check_can_be_simulated(site, method)
    if site.unplaced:
        names = ", ".join(str(anchor.id) for anchor in site.unplaced)
        print(f"not simulated, as the site file has no position: anchor {names}", file=sys.stderr)


def check_live(site: "Site", method: str = DEFAULT_METHOD) -> None:
    """As ``check_simulated``, and warns of sites that send too much to emulate in real time. Raises SkylessError."""
    from skyless.site.slots import beacon_period_s

    check_simulated(site, method)
    sent_hz = len(site.anchors) / beacon_period_s(site)
    if sent_hz > _MOST_LIVE_HZ:
        print(
            f"warning: {len(site.anchors)} anchors send {sent_hz:.0f} beacons/s, too many to emulate in real time: "
            "fixes will be late or none; skyless simulate does not need real time",
            file=sys.stderr,
        )
