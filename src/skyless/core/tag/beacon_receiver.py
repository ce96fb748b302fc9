"""What the receivers of both protocols have in common."""

from abc import ABC, abstractmethod
from collections import Counter
from math import inf, isfinite
from typing import Final, Protocol

from msgspec import Struct

from skyless.core.air.almanac import GeoreferencePage
from skyless.core.air.reception import Reception
from skyless.core.air.site_choice import NO_SITE
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import IntegrityRequirement
from skyless.core.tag.admission import COUNTER_JUMPED, DROP_COUNTERS, SITE_CHANGED, Admission, check
from skyless.core.tag.joint import Estimation
from skyless.core.ticks import FixTime

NOT_DROPS: Final = frozenset({"heard", "fixes", "anchor-restart", "counter-jump", "site-change"})
"""Counters of a receiver that do not count dropped frames."""


class MethodOptions(Struct, frozen=True):
    """What the tag's owner configures."""

    method: str
    """One of ``METHODS``."""
    qa: float
    """Spectral density of the tag's acceleration, m²/s³ per axis (filters)."""
    z_bounds_m: tuple[float, float] | None
    """Decides between mirror solutions."""
    integrity: IntegrityRequirement
    """What is required of the protection levels (``joint``)."""


class HeardSite(Struct, frozen=True):
    """What beacons have made known of a site for others than the tag itself."""

    anchors_m: dict[int, tuple[float, float, float]]
    """Positions of the anchors."""
    georeference: GeoreferencePage | None
    is_complete: bool
    """Whether a georeference cannot come any more; protocol 1 does not say whether there is one."""


class SiteListener(Protocol):
    """What programs show of a tag, besides its fixes."""

    @property
    def counters(self) -> Counter[str]:
        """Frames by what became of them."""

    @property
    def reason(self) -> NoFixReason:
        """Why the last frame has made no fix."""

    @property
    def site(self) -> int | None:
        """Identifier of the site that it receives, None before the first beacon."""

    @property
    def heard_site(self) -> HeardSite | None:
        """The site in use, once all that a tag needs of it is known."""

    @property
    def multipath_m(self) -> tuple[float, float] | None:
        """Standard deviation by which ranges change, and over which distance, where it exceeds what the site states."""

    @property
    def phase_anchors(self) -> tuple[int, ...]:
        """Identifiers of the anchors the phases of whose carriers are in use."""


class TagReceiver(SiteListener, Protocol):
    """What programs, replays and simulations see of a tag. Bytes and ticks in, fixes out; no I/O, no clock."""

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air; a fix if it made one, else ``reason`` is set."""

    def state(self) -> Struct:
        """All that it keeps, as it is now; to be used or encoded before its next frame, as parts are shared."""


class AdmissionState(Struct, frozen=True):
    """What a ``BeaconReceiver`` keeps itself."""

    options: MethodOptions
    only_site: int | None
    counters: dict[str, int]
    reason: NoFixReason


class BeaconReceiver(ABC):
    """One listening tag that understands one protocol."""

    def __init__(self, options: MethodOptions) -> None:
        """Make one that has heard nothing."""
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        self._options = options

    @property
    @abstractmethod
    def admission(self) -> Admission:
        """What it knows of its own counter, of sites and of anchors."""

    @property
    def site(self) -> int | None:
        """Identifier of the site that it receives, None before the first beacon."""
        choice = self.admission.choice
        return _site_of(choice.only_site if choice.site == NO_SITE else choice.site)

    @property
    @abstractmethod
    def heard_site(self) -> HeardSite | None:
        """The site in use, once all that a tag needs of it is known."""

    @property
    @abstractmethod
    def _estimation(self) -> Estimation | None:
        """The method in use where it is ``joint``."""

    @property
    def multipath_m(self) -> tuple[float, float] | None:
        """Standard deviation by which ranges change, and over which distance, where it exceeds what the site states."""
        return None if self._estimation is None else self._estimation.estimator.multipath_m

    @property
    def phase_anchors(self) -> tuple[int, ...]:
        """Identifiers of the anchors the phases of whose carriers are in use."""
        return () if self._estimation is None else self._estimation.estimator.phase_anchors

    def hear_height(self, height_m: float, std_m: float) -> bool:
        """Process a reading of the tag's height sensor, above the site's origin, at the present; True if it was used.

        Only ``joint`` uses it. Before the first fix it bounds the heights of the search. Recordings do
        not hold these readings, so a replay lacks them.

        Raises:
            ValueError: the height is not finite, or its standard deviation not a length.
        """
        if not (isfinite(height_m) and 0.0 < std_m < inf):
            raise ValueError(
                f"height_m is {height_m!r} and std_m is {std_m!r}; both should be finite numbers, std_m above 0"
            )
        method = self._estimation
        return method is not None and method.update_height(height_m, std_m)

    def continue_time_of(self, other: "BeaconReceiver", fix_time: FixTime) -> None:
        """Count the tag's counter on as another receiver does, and the time of fixes from ``fix_time`` on."""
        self.admission.time, self.admission.own = fix_time, other.admission.own

    def _count_events(self, events: int) -> None:
        """Count what has happened to the tag's counter and site."""
        if events & COUNTER_JUMPED:
            self.counters["counter-jump"] += 1
        if events & SITE_CHANGED:
            self.counters["site-change"] += 1

    def _count_drop(self, outcome: int) -> None:
        """Count a frame that is not used."""
        for name in DROP_COUNTERS[outcome]:
            self.counters[name] += 1

    def _judge(self, result: Fix | NoFixReason) -> Fix | None:
        """Count what a beacon that is used has led to."""
        if isinstance(result, Fix):
            self.counters["fixes"] += 1
            return result
        self.reason = result
        if result is NoFixReason.RESIDUALS:
            self.counters["outlier"] += 1
        return None

    def _admission_state(self) -> AdmissionState:
        only_site = _site_of(self.admission.choice.only_site)
        return AdmissionState(self._options, only_site, dict(self.counters), self.reason)

    def _restore_admission(self, state: AdmissionState) -> None:
        """Continue; raises ValueError where the admission, which has been restored already, is of another site."""
        check(self.admission)
        if state.only_site != _site_of(self.admission.choice.only_site):
            raise ValueError(f"the receiver's state is of site {state.only_site}, and listens to another one")
        self._options = state.options
        self.counters.update(state.counters)
        self.reason = state.reason


def _site_of(site: int) -> int | None:
    return None if site == NO_SITE else site
