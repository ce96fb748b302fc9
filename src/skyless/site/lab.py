"""The lab: the named scenario that the figures of ``MATHS.md`` section 5 belong to."""

from skyless.site.model import AnchorSite, ScheduleSite, Site, TagsSite

_PLACES = ((0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (6.0, 8.0), (0.0, 8.0), (0.0, 4.0))


def lab_site() -> Site:
    """Six anchors on the walls of 6 m × 8 m, the first one the master; tags at the anchors' height (2-D)."""
    return Site(
        name="lab",
        id=1,
        master=1,
        anchors=tuple(AnchorSite(id=number, x_m=x, y_m=y) for number, (x, y) in enumerate(_PLACES, start=1)),
        schedule=ScheduleSite(slot_s=2.5e-3),
        tags=TagsSite(height_m=0.0),
    )
