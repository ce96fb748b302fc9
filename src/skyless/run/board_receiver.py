"""A tag whose board computes: its fixes, and what it says of itself and of the site, in place of a receiver."""

from collections import Counter

import numpy as np
from msgspec.structs import replace

from skyless.core.air.almanac import GeoreferencePage
from skyless.core.fix import Fix, NoFixReason
from skyless.core.tag.receiver import HeardSite
from skyless.radio.tag_reports import AnchorPlace, BoardFix, BoardStatus, TagReport


class BoardReceiver:
    """One tag (``skyless.core.tag.receiver.SiteListener``)."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self.reason = NoFixReason.NO_BEACONS
        self.site: int | None = None
        self.multipath_m: tuple[float, float] | None = None
        self.phase_anchors: tuple[int, ...] = ()
        self._anchors_m: dict[int, tuple[float, float, float]] = {}
        self._georeference: GeoreferencePage | None = None

    @property
    def heard_site(self) -> HeardSite | None:
        """The anchors that the board has used."""
        earth = self._georeference
        return HeardSite(self._anchors_m, earth, is_complete=earth is not None) if self._anchors_m else None

    def take(self, report: TagReport) -> Fix | None:
        """Process what the board says; a fix if it is one."""
        if isinstance(report, BoardFix):
            self._enter(report.site)
            known = all(anchor in self._anchors_m for anchor in report.fix.anchors)
            places = [self._anchors_m[anchor] for anchor in report.fix.anchors] if known else []
            return replace(report.fix, anchors_m=np.array(places).reshape(-1, 3))
        if isinstance(report, BoardStatus):
            self._enter(report.site)
            self.reason = report.reason or self.reason
            self.counters = Counter(report.counters)
        elif isinstance(report, AnchorPlace):
            self._anchors_m = self._anchors_m | {report.anchor: report.position_m}
        else:
            self._georeference = report
        return None

    def _enter(self, site: int | None) -> None:
        """Another site has other anchors."""
        if self.site is not None and site not in (None, self.site):
            self._anchors_m, self._georeference = {}, None
        self.site = self.site if site is None else site
