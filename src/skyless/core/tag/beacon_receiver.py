"""What the receivers of both protocols have in common: which beacons are admitted.

A beacon is admitted if it is of the site in use, and its stamps are possible on its sender's and the tag's counter.
"""

from abc import ABC, abstractmethod
from collections import Counter
from math import inf, isfinite
from typing import Final, Generic, Protocol, TypeVar

from msgspec import Struct

from skyless.core.air.almanac import GeoreferencePage
from skyless.core.air.anchor_stamps import AnchorStamps, StampTracks
from skyless.core.air.first_path import variance_factor
from skyless.core.air.frame import AnyBeacon, Malformed
from skyless.core.air.reception import Reception
from skyless.core.air.site_choice import SiteChoice, SiteUse
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import IntegrityRequirement
from skyless.core.tag.joint import Estimation
from skyless.core.ticks import LAST_TICKS, FixTime, Unwrapper, from_seconds

NOT_DROPS: Final = frozenset({"heard", "fixes", "anchor-restart", "counter-jump", "site-change"})
"""Counters of a receiver that do not count dropped frames."""

COUNTER_JUMP_TICKS: Final = from_seconds(1.0)
"""Stamps that go back farther than radios and hosts reorder them mean that the tag's own counter has restarted."""

B = TypeVar("B", bound=AnyBeacon)


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


class TagReceiver(Protocol):
    """What programs, replays and simulations see of a tag. Bytes and ticks in, fixes out; no I/O, no clock."""

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

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air; a fix if it made one, else ``reason`` is set."""

    def state(self) -> Struct:
        """All that it keeps, as it is now; to be used or encoded before its next frame, as parts are shared."""


class AdmissionState(Struct, frozen=True):
    """What a ``BeaconReceiver`` keeps itself."""

    options: MethodOptions
    choice: SiteChoice
    counters: dict[str, int]
    reason: NoFixReason
    time: FixTime
    own_ticks: Unwrapper
    stamps: StampTracks


class BeaconReceiver(ABC, Generic[B]):
    """One listening tag that understands one protocol."""

    def __init__(self, options: MethodOptions, site: int | None) -> None:
        """``site``: the only one to listen to; None for that with most anchors."""
        self.counters: Counter[str] = Counter()
        self.reason: NoFixReason = NoFixReason.NO_BEACONS
        self._options = options
        self._choice = SiteChoice(site)
        self._time = FixTime()
        self._own_ticks = Unwrapper()
        self._stamps = AnchorStamps(self.counters)

    @property
    def site(self) -> int | None:
        """Identifier of the site that it receives, None before the first beacon."""
        return self._choice.only_site if self._choice.site is None else self._choice.site

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

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air; a fix if it made one, else ``reason`` is set.

        What does not belong here is counted in ``counters`` and dropped; nothing on the air raises.
        """
        beacon = self._decode(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return None
        return self.hear_beacon(beacon, reception)

    def hear_beacon(self, beacon: B, reception: Reception) -> Fix | None:
        """Process a beacon that is decoded already, as ``hear`` does."""
        rx_ticks = self._own_ticks.unwrap(reception.rx_ticks, reception.host_s)
        tx_ticks = self._admit(beacon, rx_ticks)
        if tx_ticks is None:
            return None
        self.counters["heard"] += 1
        result = self._process(beacon, reception, rx_ticks, tx_ticks)
        if isinstance(result, Fix):
            self.counters["fixes"] += 1
            self._choice.on_fix(rx_ticks)
            return result
        self.reason = result
        if result is NoFixReason.RESIDUALS:
            self.counters["outlier"] += 1
        return None

    @abstractmethod
    def _decode(self, frame: bytes) -> B | Malformed:
        """The beacon in a frame."""

    @abstractmethod
    def _process(self, beacon: B, reception: Reception, rx_ticks: int, tx_ticks: int) -> Fix | NoFixReason:
        """Process a beacon that is admitted; stamps are unwrapped."""

    @abstractmethod
    def _period_ticks(self, beacon: B) -> int:
        """Mean time between two beacons of an anchor, as far as it is known."""

    @abstractmethod
    def _forget_site(self) -> None:
        """Another site is in use from now on: forget all that beacons have made known."""

    @abstractmethod
    def _forget_stamps(self) -> None:
        """The tag's counter has restarted: forget all but what the site has in common."""

    def _admit(self, beacon: B, rx_ticks: int) -> int | None:
        """TX stamp, unwrapped, of a beacon that may be used; None for others, which are counted."""
        newest = self._stamps.tracks.newest_rx_ticks
        jumped = newest is not None and rx_ticks < newest - COUNTER_JUMP_TICKS
        if (jumped or not -LAST_TICKS <= rx_ticks <= LAST_TICKS) and not self._restart(rx_ticks):
            return None
        if not self._is_of_site(beacon, rx_ticks):
            return None
        tx_ticks = self._stamps.unwrap(beacon, rx_ticks, self._period_ticks(beacon))
        if tx_ticks is not None:
            self._choice.heard_ticks = rx_ticks
        return tx_ticks

    def _restart(self, rx_ticks: int) -> bool:
        """Forget all stamps, as the tag's counter restarted; False where the host's clock jumped by over a year."""
        self._stamps.forget()
        self._forget_stamps()
        if abs(rx_ticks) <= LAST_TICKS:
            self.counters["counter-jump"] += 1
            self._choice.restart(rx_ticks)
            return True
        self.counters["impossible-host-time"] += 1
        self._own_ticks = Unwrapper()
        self._choice.restart(0)
        return False

    def _is_of_site(self, beacon: B, rx_ticks: int) -> bool:
        """Whether a beacon is of the site in use, which may have changed."""
        had_site = self._choice.site is not None
        use = self._choice.on_beacon(beacon.site, beacon.anchor, rx_ticks)
        if use is SiteUse.FOREIGN:
            self.counters["foreign-site"] += 1
            return False
        if use is SiteUse.CHANGED and had_site:
            self.counters["site-change"] += 1
            self._forget_site()
            self._stamps.forget()
            self._forget_stamps()
        return True

    def _admission_state(self) -> AdmissionState:
        return AdmissionState(
            self._options,
            self._choice,
            dict(self.counters),
            self.reason,
            self._time,
            self._own_ticks,
            self._stamps.tracks,
        )

    def _restore_admission(self, state: AdmissionState) -> None:
        self._options, self._choice = state.options, state.choice
        self.counters.update(state.counters)
        self.reason = state.reason
        self._time, self._own_ticks = state.time, state.own_ticks
        self._stamps = AnchorStamps(self.counters, state.stamps)


def variance_factor_of(reception: Reception) -> float:
    """Factor on the variance of a reception, from what the radio measured of it."""
    measured = reception.diagnostics
    return 1.0 if measured is None else variance_factor(measured.rx_power_dbm, measured.first_path_power_dbm)
