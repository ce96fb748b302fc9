"""Which machine an anchor needs: by the mode of its site's schedule."""

from skyless.anchor import Anchor
from skyless.anchors.authentication import BeaconAuthentication
from skyless.anchors.free import FreeAnchor
from skyless.anchors.slots import SlotsAnchor
from skyless.site.model import Site

AnyAnchor = Anchor | FreeAnchor | SlotsAnchor


def new_anchor(
    site: Site, anchor_id: int, lead_s: float = 1e-3, authentication: BeaconAuthentication | None = None
) -> AnyAnchor:
    """Return the machine of an anchor of a validated site; ``lead_s``: how early its driver needs a frame.

    ``authentication``: its keys; protocol 1 knows none.

    Raises:
        KeyError: the site has no such anchor.
    """
    match site.schedule.mode:
        case "master":
            return Anchor(site, anchor_id, lead_s)
        case "slots":
            return SlotsAnchor(site, anchor_id, lead_s, authentication)
        case "free":
            return FreeAnchor(site, anchor_id, lead_s, authentication)
