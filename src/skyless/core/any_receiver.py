"""``AnyReceiver``: a tag that finds out which protocol the anchors around it use."""

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from msgspec import Struct

from skyless.core.air.beacon import Beacon
from skyless.core.air.beacon_fields import VERSION_2
from skyless.core.air.frame import Malformed, has_version
from skyless.core.air.reception import Reception
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD, FILTERS
from skyless.core.protocol1 import receiver as protocol1
from skyless.core.protocol1.snapshots import Snapshots
from skyless.core.protocols import SiteBeacon, decode_any
from skyless.core.tag.beacon_receiver import HeardSite
from skyless.core.tag.factory import ReceiverState
from skyless.core.tag.joint import Estimation
from skyless.core.tag.receiver import Receiver


class AnyReceiverState(Struct, frozen=True, tag="any"):
    """All that an ``AnyReceiver`` keeps."""

    receiver: ReceiverState | protocol1.ReceiverState
    others: int


MAX_OTHERS: Final = 200
"""Beacons of the other protocol, without a fix meanwhile, after which a tag listens to that one."""


class AnyReceiver:
    """One listening tag, at a site of either protocol. Bytes and ticks in, fixes out; no I/O, no clock.

    It listens to the protocol of its first beacon, and to the other one once it receives that and has no fixes.
    """

    def __init__(
        self,
        method: str = DEFAULT_METHOD,
        *,
        site: int | None = None,
        qa: float = 0.3,
        z_bounds_m: tuple[float, float] | None = None,
        integrity: IntegrityRequirement | None = None,
    ) -> None:
        """Make a tag that knows nothing yet, with the options of ``skyless.Receiver``.

        ``method`` is one of ``METHODS``; all but ``joint`` are methods of protocol 1.

        Raises:
            ValueError: there is no such method.
        """
        options: Any = {"site": site, "qa": qa, "z_bounds_m": z_bounds_m, "integrity": integrity}
        self._new: Callable[[], Receiver] = partial(Receiver, **options)
        self._new_1: Callable[[], protocol1.Receiver] = partial(protocol1.Receiver, method, **options)
        self._may_change = method in FILTERS
        self._receiver: Receiver | protocol1.Receiver = self._new() if self._may_change else self._new_1()
        self._others = 0
        """Beacons of the other protocol since the last fix."""

    def state(self) -> AnyReceiverState:
        """All that it keeps, as it is now; to be used or encoded before its next frame, as parts are shared."""
        return AnyReceiverState(self._receiver.state(), self._others)

    @classmethod
    def from_state(cls, state: AnyReceiverState | ReceiverState) -> "AnyReceiver":
        """A receiver that continues with the same bits as the one with this state, which may be a ``Receiver``.

        Raises:
            ValueError: no receiver has such a state.
        """
        state = AnyReceiverState(state, 0) if isinstance(state, ReceiverState) else state
        admission = state.receiver.admission
        options = admission.options
        made = cls(
            options.method,
            site=admission.only_site,
            qa=options.qa,
            z_bounds_m=options.z_bounds_m,
            integrity=options.integrity,
        )
        saved = state.receiver
        if isinstance(saved, ReceiverState):
            made._receiver = Receiver.from_state(saved)
        else:
            made._receiver = protocol1.Receiver.from_state(saved)
        made._others = state.others
        return made

    @property
    def receiver(self) -> Receiver | protocol1.Receiver:
        """The receiver of the protocol in use."""
        return self._receiver

    @property
    def counters(self) -> Counter[str]:
        """Frames by what became of them."""
        return self._receiver.counters

    @property
    def reason(self) -> NoFixReason:
        """Why the last frame has made no fix."""
        if not self._may_change and self.counters["other-version"] and not self.counters["heard"]:
            return NoFixReason.NO_MASTER
        return self._receiver.reason

    @property
    def site(self) -> int | None:
        """Identifier of the site that it receives, None before the first beacon."""
        return self._receiver.site

    @property
    def method(self) -> Estimation | Snapshots | None:
        """The positioning method in use, None before the almanac is known."""
        return self._receiver.method

    @property
    def multipath_m(self) -> tuple[float, float] | None:
        """Standard deviation by which ranges change, and over which distance, where it exceeds what the site states."""
        return self._receiver.multipath_m

    @property
    def phase_anchors(self) -> tuple[int, ...]:
        """Identifiers of the anchors the phases of whose carriers are in use."""
        return self._receiver.phase_anchors

    @property
    def heard_site(self) -> HeardSite | None:
        """Anchors and georeference of the site, None before they are known."""
        return self._receiver.heard_site

    def hear_height(self, height_m: float, std_m: float) -> bool:
        """Process a reading of the tag's height sensor, as ``Receiver.hear_height`` does."""
        return self._receiver.hear_height(height_m, std_m)

    def hear(self, reception: Reception) -> Fix | None:
        """Process a frame from the air; a fix if it made one, else ``reason`` is set.

        What does not belong here is counted in ``counters`` and dropped; nothing on the air raises.
        """
        receiver, frame = self._receiver, reception.frame
        if isinstance(receiver, Receiver) and has_version(frame, VERSION_2):
            fix = receiver.hear(reception)
            if fix is not None:
                self._others = 0
            return fix
        beacon = decode_any(frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return None
        return self.hear_beacon(beacon, reception)

    def hear_beacon(self, beacon: SiteBeacon, reception: Reception) -> Fix | None:
        """Process a beacon that is decoded already, as ``hear`` does; of protocol 2 the frame itself may be empty."""
        if isinstance(beacon, Beacon) is not isinstance(self._receiver, Receiver) and not self._change():
            self.counters["other-version"] += 1
            return None
        fix = self._receiver.hear_beacon(beacon, reception)  # type: ignore[arg-type]  # it is of its protocol
        if fix is not None:
            self._others = 0
        return fix

    def _change(self) -> bool:
        """Listen to the other protocol, unless the present one gives fixes, or may still."""
        if not self._may_change:
            return False
        self._others += 1
        if self.counters["heard"] and self._others <= MAX_OTHERS:
            return False
        counters = self.counters
        self._receiver = self._new_1() if isinstance(self._receiver, Receiver) else self._new()
        self._receiver.counters.update(counters)
        self._others = 0
        return True
