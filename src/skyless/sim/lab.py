"""The site ``lab``, the reference of the simulated world (``docs/maths.md`` section 5)."""

from typing import Final

from msgspec.structs import replace

from skyless.core.site import EXACT, AccuracySite, AnchorSite, NoiseSite, ScheduleSite, Site, TagsSite

_TYPICAL: Final = AccuracySite()

_POSITIONS_M: Final = ((0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (6.0, 8.0), (0.0, 8.0), (0.0, 4.0))


def lab_site(noise_ps: float = 100.0, accuracy: AccuracySite = _TYPICAL) -> Site:
    """Six anchors on the walls of 6 m × 8 m that send at random instants; tags at the anchors' height (2-D).

    ``noise_ps``: noise of TX and RX stamps assumed by the filters. ``accuracy``: errors of survey and ranges assumed by
    them, by default those of a typical real site.
    """
    return Site(
        name="lab",
        id=1,
        master=1,
        anchors=tuple(AnchorSite(id=number, x_m=x, y_m=y) for number, (x, y) in enumerate(_POSITIONS_M, start=1)),
        noise=NoiseSite(tx_stamp_ps=noise_ps, rx_stamp_ps=noise_ps),
        schedule=ScheduleSite(mode="free"),
        tags=TagsSite(height_m=0.0),
        accuracy=accuracy,
    )


def ideal_lab_site(noise_ps: float = 100.0) -> Site:
    """The same site with exact survey and ranges, like the simulated world's by default."""
    return lab_site(noise_ps, EXACT)


def paper_lab_site(noise_ps: float = 100.0, accuracy: AccuracySite = EXACT) -> Site:
    """The same anchors as in the paper: slots of 2.5 ms on the time of the first one, the master."""
    return replace(lab_site(noise_ps, accuracy), schedule=ScheduleSite(slot_s=2.5e-3))
