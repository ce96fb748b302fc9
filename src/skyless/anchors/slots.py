"""``SlotsAnchor``: an anchor that sends in slots, on a slot time that no single anchor keeps.

Claims say whose counter leads (``skyless.slot_claims``), the composed time carries it from parents to the own counter
(``skyless.clocks.composed_time``). The own counter itself is never set: tags compute with raw stamps.
"""

import math
from collections import Counter
from typing import Final

from msgspec import Struct

from skyless.air.beacon2 import Beacon2, SlotTime, StatedSiteTime
from skyless.air.codec2 import MOST_RESIDUAL_TICKS, encode_2, heard_capacity_2
from skyless.air.reception import Reception, Transmission
from skyless.anchor import anchor_of, delay_change_ticks
from skyless.anchors.authentication import BeaconAuthentication, contents_of, sealed
from skyless.anchors.neighbours import Admitted, Neighbours, on_radio_grid
from skyless.clocks.composed_time import SUPERFRAME_BITS, ComposedTime
from skyless.clocks.composition import MEAN_LATE_TICKS
from skyless.clocks.filter import MAX_RELATIVE_RATE, clock_noise, stamp_variance_m2
from skyless.constants import DELAYED_TX_GRANULARITY_TICKS, MAX_DRIFT, SUBTICKS, TICK_M, TICK_S
from skyless.site.local_almanac import site_issue, site_pages_of
from skyless.site.model import Site
from skyless.site.slots import first_slots, schedule_of
from skyless.slot_claims import ClaimVerdict, Lead, SlotClaims, SlotRole, first_wait_superframes, rank_of
from skyless.ticks import difference, from_seconds, nearest, wrap

GUARD_S: Final = 2e-6
"""Slots that differ by more are another phase, before which an anchor is silent; and an oscillator's tolerance for a
superframe comes on top, for anchors that do not know their rate yet."""

_DROPPED: Final = frozenset({ClaimVerdict.OFF_PHASE, ClaimVerdict.EXPIRED, ClaimVerdict.HELD, ClaimVerdict.LESSER})


class SlotSynchronisation(Struct, frozen=True):
    """What an anchor follows."""

    role: SlotRole
    root: int | None
    """Identifier of the anchor whose counter leads; None while listening."""
    term: int | None
    hop: int | None
    """Links from the root; 0 for the root itself."""
    parents: tuple[int, ...]
    rate_ppm: float
    """Of the own counter against the slot time; 0 before it is known."""


class _Pending(Struct, frozen=True, gc=False):
    """The frame that was asked for last."""

    superframe: int
    slot: int
    phase: int
    """Number of changes of phase up to then."""


class SlotsAnchor:
    """One anchor of a site of mode slots. Like ``Anchor`` it does no I/O and reads no clock."""

    def __init__(
        self, site: Site, anchor_id: int, lead_s: float = 1e-3, authentication: BeaconAuthentication | None = None
    ) -> None:
        """``lead_s``: how long before its RMARKER a frame must be in the driver's hands.

        ``authentication``: the keys; None for an anchor that sends without codes and accepts all frames.

        Raises:
            KeyError: the site has no such anchor.
        """
        self.id = anchor_id
        self.counters: Counter[str] = Counter()
        self._site = site
        self._lead_ticks = from_seconds(lead_s)
        self._schedule = schedule_of(site)
        self._slots = self._schedule.slots_of(first_slots(site)[anchor_id])
        self._delay_ticks = anchor_of(site, anchor_id).tx_antenna_delay_ticks
        self._correction_ticks = 0
        self._states_site_time = site.schedule.site_time
        self._pages = site_pages_of(site)
        self._issue = site_issue(self._pages)
        self.authentication = authentication
        self._neighbours = Neighbours(site, anchor_id, self.counters, authentication)
        superframe_ticks = self._schedule.superframe_ticks
        wait = first_wait_superframes(rank_of(anchor_id, (anchor.id for anchor in site.all_anchors)))
        self._claims = SlotClaims(anchor_id, superframe_ticks, wait)
        noise = site.noise
        variance = stamp_variance_m2(noise.tx_stamp_ps * 1e-12, rounded=False)
        variance += stamp_variance_m2(noise.rx_stamp_ps * 1e-12, rounded=True)
        self._time = ComposedTime(
            clock_noise(noise.white_fm, noise.random_walk_fm), variance, self._schedule, self.counters
        )
        self._guard_ticks = from_seconds(GUARD_S) + round(MAX_RELATIVE_RATE * superframe_ticks)
        self._chosen_ticks: int | None = None
        self._pending: dict[int, _Pending] = {}
        self._phase = 0
        self._sequence = 0

    def place(self, site: Site) -> None:
        """Use other positions and antenna delays of the same anchors, as ``Anchor.place``; the slot time goes on."""
        self._correction_ticks = delay_change_ticks(self._site, site, self.id)
        self._pages = site_pages_of(site)
        self._issue = site_issue(self._pages)
        self._neighbours.place(site)
        self._time.correct_ranges()

    @property
    def synchronisation(self) -> SlotSynchronisation:
        """Whom it follows at present."""
        claims, claim = self._claims, self._claims.claim
        root, term, hop = (None, None, None) if claim is None else (claim.root, claim.term, claims.hop)
        parents = self._time.parents if claims.role is SlotRole.FOLLOWER else ()
        return SlotSynchronisation(claims.role, root, term, hop, parents, self._time.rate * 1e6)

    def slot_time(self, now_ticks: int) -> tuple[float, int] | None:
        """Own counter less the slot time in s, modulo the wrap, and the superframe; None before it is known.

        ``now_ticks`` is the own counter, 40 bits.
        """
        if not self._time.is_known:
            return None
        own_ticks = self._neighbours.own_ticks.expect(now_ticks)
        ticks, fraction = divmod(self._time.subticks(own_ticks), SUBTICKS)
        offset_s = (difference(wrap(own_ticks), wrap(ticks)) - fraction / SUBTICKS) * TICK_S
        return offset_s, self._time.superframe(own_ticks)

    def slot_start_ticks(self, superframe: int, slot: int) -> int | None:
        """Own reading, unwrapped, at which a slot begins; None before the slot time is known."""
        start = self._schedule.slot_start_ticks(superframe, slot)
        return self._time.ticks_own(start) if self._time.is_known else None

    def hear(self, reception: Reception) -> None:
        """Process a frame from the air; one that does not belong here is counted and dropped."""
        admitted = self._neighbours.admit(reception)
        if admitted is None:
            return
        slot_time = admitted.beacon.slot_time
        if slot_time is None or not (admitted.fits or self._claims.claim is None):
            return  # its stamps are relayed all the same
        if slot_time.slot >= self._schedule.slots or abs(slot_time.rate) > MAX_DRIFT:
            self.counters["impossible-slot-time"] += 1
            return
        self._update_claims(admitted, slot_time)

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """TX stamp (40-bit, own counter) of the next frame that can still be made; None while it must be silent."""
        now = self._neighbours.own_ticks.unwrap(now_ticks)
        self._advance(now)
        if not self._time.is_known:
            return None
        earliest = now + self._lead_ticks + DELAYED_TX_GRANULARITY_TICKS
        superframe, slot = self._schedule.next_slot(self._time.subticks(earliest) // SUBTICKS + 1, self._slots)
        start = self._time.ticks_own(self._schedule.slot_start_ticks(superframe, slot))
        tx_ticks = on_radio_grid(start, self._delay_ticks)
        if not self._claims.may_send(tx_ticks):
            return None
        self._pending = {wrap(tx_ticks): _Pending(superframe, slot, self._phase)}
        return wrap(tx_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        """The frame for a time that ``next_transmission_ticks`` gave.

        Raises:
            KeyError: the time is not the one that was given last.
        """
        pending = self._pending.pop(tx_ticks)
        unwrapped = self._neighbours.own_ticks.expect(tx_ticks)
        self._advance(unwrapped - self._lead_ticks)
        stated_ticks = unwrapped + self._correction_ticks
        added = contents_of(self.authentication, tx_ticks, self._sequence, self.id)
        slot_time, site_time, position = None, None, None
        if added.certificate is None:
            slot_time, site_time = self._stated(pending, stated_ticks)
            position = self._neighbours.position
        capacity = heard_capacity_2(
            slot_time=slot_time is not None,
            position=position is not None,
            site_time=site_time is not None,
            certificate=added.certificate is not None,
        )
        heard, weak = self._neighbours.relayed(unwrapped, capacity)
        beacon = Beacon2(
            self._site.id, self.id, self._sequence, wrap(stated_ticks), self._issue, slot_time, position, site_time,
            heard, weak, added.page(self._pages, self._sequence, self.id), added.certificate,
        )  # fmt: skip
        self._claims.on_sent(unwrapped)
        self._neighbours.on_sent(self._sequence, stated_ticks)
        self._sequence = (self._sequence + 1) & 0xFF
        self.counters["sent"] += 1
        return Transmission(sealed(self.authentication, encode_2(beacon), added), tx_ticks)

    def _update_claims(self, admitted: Admitted, stated: SlotTime) -> None:
        """Follow the claim of a beacon, and its sender if it is a parent."""
        anchor, rx_ticks = admitted.beacon.anchor, admitted.rx_ticks
        rate = (1.0 + self._time.rate) / (1.0 + stated.rate) - 1.0 if self._time.is_known else None
        range_m = self._neighbours.range_m(admitted, rate)
        off_phase = self._is_off_phase(stated, rx_ticks - round(range_m / TICK_M))
        verdict = self._claims.on_beacon(anchor, stated, rx_ticks, off_phase, admitted.power_dbm)
        if verdict in _DROPPED:
            self.counters[verdict] += 1
            return
        if verdict is not ClaimVerdict.SAME:
            self.counters["claim-change"] += 1
            if verdict is ClaimVerdict.ADOPTED_OTHER_PHASE:
                self.counters["phase-change"] += 1
                self._phase += 1
                self._time.restart()
            self._time.stop_leading()
            self._time.set_parents((anchor,))
        if anchor in self._time.parents:
            site_time = admitted.beacon.site_time if self._states_site_time else None
            self._time.on_beacon(anchor, admitted.beacon.tx_ticks, rx_ticks, range_m, stated, site_time)

    def _is_off_phase(self, stated: SlotTime, left_ticks: int) -> bool:
        """Whether a frame that left at this own time was not in the slot that it states; False before it is known."""
        if not self._time.is_known:
            return False
        superframe = nearest(stated.superframe, self._time.superframe(left_ticks), SUPERFRAME_BITS)
        start = self._time.ticks_own(self._schedule.slot_start_ticks(superframe, stated.slot))
        return abs(left_ticks + MEAN_LATE_TICKS - start) > self._guard_ticks

    def _advance(self, now: int) -> None:
        """Lead if it is time, and choose parents once in a superframe."""
        lead = self._claims.advance(now)
        if lead is not None:
            self.counters["takeover"] += lead is Lead.TAKEOVER
            self._time.lead(now)
        if self._chosen_ticks is None or now - self._chosen_ticks >= self._schedule.superframe_ticks:
            self._chosen_ticks = now
            parents = self._claims.choose_parents(now)
            if parents and parents != self._time.parents:
                self._time.set_parents(parents)

    def _stated(self, pending: _Pending, tx_ticks: int) -> tuple[SlotTime | None, StatedSiteTime | None]:
        """Slot time and site time of a frame; none of one that was due when its sender changed phase."""
        claims, claim = self._claims, self._claims.claim
        if claim is None or pending.phase != self._phase or not self._time.is_known:
            return None, None
        if abs(self._time.rate) > MAX_DRIFT:
            return None, None  # nobody would accept it
        superframe = wrap(pending.superframe, SUPERFRAME_BITS)
        slot_time = SlotTime(
            superframe, pending.slot, claim.root, claim.term, claims.hop, claims.pulse_age(superframe), self._time.rate
        )
        if not self._states_site_time or self._time.variance_m2(tx_ticks) == math.inf:
            return slot_time, None
        site_time = self._time.stated(tx_ticks, pending.superframe, pending.slot)
        fits = abs(site_time.residual_ticks) <= MOST_RESIDUAL_TICKS
        return slot_time, site_time if fits else None  # it does not where the timeline moved after the time was given
