"""Beacons of protocol 1 and their bytes (``docs/protocol.md``).

48-bit times travel as a low word and a high half-word.
"""

import math
import struct
from collections.abc import Collection
from functools import lru_cache
from operator import index
from typing import Final, SupportsIndex

from msgspec import Struct

from skyless.core.air.almanac import Page, SchedulePage
from skyless.core.air.frame import (
    BEACON_MAGIC,
    BROADCAST,
    FCS_BYTES,
    FRAME_CONTROL,
    HEARD,
    MAX_FRAME_BYTES,
    Heard,
    Malformed,
    PackedHeard,
    fcs,
    is_intact,
    not_a_beacon,
)
from skyless.core.air.site_pages import PAGE_BYTES, decode_page, encode_page
from skyless.core.site import Site
from skyless.core.ticks import DELAYED_TX_GRANULARITY_TICKS, TICK_RATE_HZ


class MasterTime(Struct, frozen=True, gc=False):
    """The frame's TX time on the master's scale, as the sending anchor's clock filter knows it."""

    tx_subticks_master: int
    """TX time on the site's scale, which the master keeps, in 1/256 tick, 48 bits."""
    std_ticks: float
    """Standard deviation of that time in ticks; sent in steps of 1/64 tick up to 1023.98."""


class Beacon(Struct, frozen=True, gc=False):
    """One decoded beacon frame, version 1."""

    site: int
    """Site identifier, 16 bits, sent as the PAN identifier."""
    anchor: int
    """Identifier of the sending anchor, 16 bits, sent as the short source address."""
    sequence: int
    """Frame counter of the sender, 8 bits."""
    superframe: int
    """Number of the superframe, 32 bits, counted by the master."""
    slot: int
    """Slot within the superframe in which this frame is sent, 8 bits."""
    tx_ticks: int
    """TX stamp in the sender's own clock, 40 bits."""
    almanac_issue: int
    """Changes when the almanac changes, 8 bits; a tag then discards the old one."""
    master: int
    """Identifier of the master whose time this anchor uses; its own for the master."""
    term: int
    """Counts the takeovers of the master's role, modulo 256 (8 bits)."""
    master_heard: Heard | None
    """The last master beacon that this anchor heard (raw stamp), None for the master or when none was heard."""
    master_time: MasterTime | None
    """None until the sender's clock is known against the master; exact (std 0) for the master itself."""
    heard: tuple[Heard, ...] | PackedHeard
    """The other anchors, the master excluded, in the order of the most recent first; as many as fit."""
    page: Page | None
    """One page of the almanac."""

    @property
    def relayed(self) -> tuple[Heard, ...]:
        """All receptions of other anchors, the master's last."""
        return (*self.heard,) if self.master_heard is None else (*self.heard, self.master_heard)


AUTHENTICATION_BYTES: Final = 16
"""Bytes that every frame reserves for an authentication trailer."""
STD_STEPS_PER_TICK: Final = 64
SATURATED_STD: Final = 0xFFFF

VERSION_1: Final = BEACON_MAGIC | 0x0100

_HAS_MASTER_HEARD: Final = 0x01
_HAS_MASTER_TIME: Final = 0x02
_HAS_PAGE: Final = 0x04
_HAS_AUTHENTICATION: Final = 0x08
_RESERVED_FLAGS: Final = 0xF0

_FIXED: Final = struct.Struct("<HBHHHHBIBIBBHB")
_FLAGS_AT: Final = 11
_STAMP: Final = struct.Struct("<BIB")
_TIME: Final = struct.Struct("<IHH")
_SHORTEST_MAC_FRAME_BYTES: Final = 5


def _bare_bytes(flags: int) -> int:
    """Length of a frame with these flags that relays no stamps."""
    return (
        _FIXED.size
        + (_STAMP.size if flags & _HAS_MASTER_HEARD else 0)
        + (_TIME.size if flags & _HAS_MASTER_TIME else 0)
        + 1
        + (PAGE_BYTES if flags & _HAS_PAGE else 0)
        + (AUTHENTICATION_BYTES if flags & _HAS_AUTHENTICATION else 0)
        + FCS_BYTES
    )


_BARE_BYTES: Final = tuple(_bare_bytes(flags) for flags in range(16))
_COUNT_AT: Final = tuple(_bare_bytes(flags & (_HAS_MASTER_HEARD | _HAS_MASTER_TIME)) - 3 for flags in range(16))
_CAPACITY: Final = tuple(
    (MAX_FRAME_BYTES - _bare_bytes(flags | _HAS_AUTHENTICATION)) // HEARD.size for flags in range(16)
)
_HEARD_ANCHORS: Final = tuple(struct.Struct("<" + count * "H6x") for count in range(MAX_FRAME_BYTES // HEARD.size))
"""The anchors alone of ``heard`` entries, by the number of entries."""
_MASTER: Final = slice(_FIXED.size - 3, _FIXED.size - 1)
_MASTERS_STAMP: Final = slice(_FIXED.size, _FIXED.size + _STAMP.size)


def heard_capacity(master_heard: bool, master_time: bool, page: bool) -> int:
    """How many ``heard`` entries a frame with these parts may carry, with space for authentication: 6 to 10."""
    return _CAPACITY[master_heard * _HAS_MASTER_HEARD | master_time * _HAS_MASTER_TIME | page * _HAS_PAGE]


def encode(beacon: Beacon) -> bytes:
    """Return the whole frame, FCS included.

    The standard deviation of the master time is rounded up to 1/64 tick, so that it is never too optimistic.

    Raises ValueError: a field is out of its range, or there are more ``heard`` than fit; the message names it.
    """
    fault = _heard_fault(beacon.anchor, beacon.master, beacon.master_heard, beacon.heard)
    if fault is not None:
        raise ValueError(fault)
    capacity = _CAPACITY[_flags(beacon)]
    if len(beacon.heard) > capacity:
        raise ValueError(f"heard has {len(beacon.heard)} entries; {capacity} fit")
    try:
        body = _body(beacon)
    except (struct.error, TypeError):
        raise ValueError(_first_fault(beacon)) from None
    return body + fcs(body)


def decode(frame: bytes) -> Beacon | Malformed:
    """Return the beacon in a whole frame (FCS included), or why there is none; never raises."""
    length = len(frame)
    if not _SHORTEST_MAC_FRAME_BYTES <= length <= MAX_FRAME_BYTES:
        return Malformed.TOO_LONG if length > MAX_FRAME_BYTES else Malformed.TOO_SHORT
    if not is_intact(frame):
        return Malformed.BAD_FCS
    return _foreign(frame) if length < _BARE_BYTES[0] else _decode_version_1(frame)


decode_cached = lru_cache(maxsize=256)(decode)
"""``decode`` that remembers the last 256 frames: for a program that runs many tags which receive the same bytes."""


def _foreign(frame: bytes) -> Malformed:
    """Why an intact frame is no beacon of version 1, where it is none or ends too early."""
    return not_a_beacon(frame, VERSION_1) or Malformed.TOO_SHORT


def _decode_version_1(frame: bytes) -> Beacon | Malformed:
    flags = frame[_FLAGS_AT]
    if flags & _RESERVED_FLAGS:
        return _foreign_or(Malformed.BAD_FLAGS, frame)
    heard_bytes, count_at = len(frame) - _BARE_BYTES[flags], _COUNT_AT[flags]
    count = heard_bytes // HEARD.size
    if heard_bytes < 0 or heard_bytes != frame[count_at] * HEARD.size:
        return _foreign_or(Malformed.BAD_LENGTH, frame)
    (
        control, sequence, site, destination, anchor, magic, _, superframe, slot, tx_low, tx_high, issue, master,
        term,
    ) = _FIXED.unpack_from(frame)  # fmt: skip
    if control != FRAME_CONTROL or destination != BROADCAST or magic != VERSION_1:
        return _foreign(frame)
    relays_master, is_master = flags & _HAS_MASTER_HEARD, anchor == master
    named = {anchor, master, *_HEARD_ANCHORS[count].unpack_from(frame, count_at + 1)}
    if len(named) + is_master != count + 2 or (relays_master and is_master):
        return Malformed.BAD_HEARD
    master_heard = master_time = None
    if relays_master:
        number, low, high = _STAMP.unpack_from(frame, _FIXED.size)
        master_heard = Heard(master, number, low | high << 32)
    if flags & _HAS_MASTER_TIME:
        low, high, std_steps = _TIME.unpack_from(frame, count_at - _TIME.size)
        master_time = MasterTime(low | high << 32, std_steps / STD_STEPS_PER_TICK)
    page_at = count_at + 1 + heard_bytes
    page = decode_page(frame[page_at : page_at + PAGE_BYTES]) if flags & _HAS_PAGE else None
    if page is Malformed.BAD_PAGE:
        return page
    return Beacon(
        site, anchor, sequence, superframe, slot, tx_low | tx_high << 32, issue, master, term,
        master_heard, master_time, PackedHeard(frame[count_at + 1 : page_at]), page,
    )  # fmt: skip


def _foreign_or(fault: Malformed, frame: bytes) -> Malformed:
    """Fault of a frame, or that it is no beacon of this version: then the fault means nothing."""
    foreign = _foreign(frame)
    return fault if foreign is Malformed.TOO_SHORT else foreign


def packed_relays(frame: bytes, beacon: Beacon) -> bytes:
    """All receptions that a beacon relays, ``HEARD`` after ``HEARD``, the master's first; ``frame`` is its bytes."""
    packed: bytes = beacon.heard.packed  # type: ignore[union-attr]  # it is of a frame
    return packed if beacon.master_heard is None else frame[_MASTER] + frame[_MASTERS_STAMP] + packed


def _heard_fault(anchor: int, master: int, master_heard: Heard | None, heard: Collection[Heard]) -> str | None:
    """What is impossible among the stamps that a beacon relays, None if nothing is."""
    if master_heard is not None and (anchor == master or master_heard.anchor != master):
        return (
            f"master_heard is of anchor {master_heard.anchor}; it must be of another than {anchor}, the master {master}"
        )
    seen = {anchor, master}
    expected = len(seen) + len(heard)
    seen.update([entry.anchor for entry in heard])
    if len(seen) == expected:
        return None
    named = [anchor, master, *(entry.anchor for entry in heard)]
    twice = next(one for index, one in enumerate(named) if index > 1 and one in named[:index])
    return f"heard repeats anchor {twice}, or it is the sender or the master"


def _body(beacon: Beacon) -> bytes:
    """All bytes before the FCS."""
    master_heard, master_time, page = beacon.master_heard, beacon.master_time, beacon.page
    flags = _flags(beacon)
    parts = [
        _FIXED.pack(
            FRAME_CONTROL, beacon.sequence, beacon.site, BROADCAST, beacon.anchor, VERSION_1, flags,
            beacon.superframe, beacon.slot, *_split(beacon.tx_ticks), beacon.almanac_issue, beacon.master,
            beacon.term,
        )
    ]  # fmt: skip
    if master_heard is not None:
        parts.append(_STAMP.pack(master_heard.sequence, *_split(master_heard.rx_ticks)))
    if master_time is not None:
        parts.append(_TIME.pack(*_split(master_time.tx_subticks_master), _std_steps(master_time.std_ticks)))
    parts.append(bytes((len(beacon.heard),)))
    parts += [HEARD.pack(entry.anchor, entry.sequence, *_split(entry.rx_ticks)) for entry in beacon.heard]
    if page is not None:
        parts.append(encode_page(page))
    return b"".join(parts)


def _flags(beacon: Beacon) -> int:
    return (
        (beacon.master_heard is not None) * _HAS_MASTER_HEARD
        | (beacon.master_time is not None) * _HAS_MASTER_TIME
        | (beacon.page is not None) * _HAS_PAGE
    )


def _split(ticks: int) -> tuple[int, int]:
    """Low word and the rest; a value out of range leaves a rest that its field cannot hold."""
    return ticks & 0xFFFFFFFF, ticks >> 32


def _std_steps(std_ticks: float) -> int:
    if not std_ticks >= 0.0:
        raise ValueError(f"master_time.std_ticks is {std_ticks!r}; it must be 0 or more")
    steps = std_ticks * STD_STEPS_PER_TICK
    return SATURATED_STD if steps >= SATURATED_STD else math.ceil(steps)


def _first_fault(beacon: Beacon) -> str:
    """Name the first field that does not fit its bits."""
    fields: list[tuple[str, object, int]] = [
        ("site", beacon.site, 16),
        ("anchor", beacon.anchor, 16),
        ("sequence", beacon.sequence, 8),
        ("superframe", beacon.superframe, 32),
        ("slot", beacon.slot, 8),
        ("tx_ticks", beacon.tx_ticks, 40),
        ("almanac_issue", beacon.almanac_issue, 8),
        ("master", beacon.master, 16),
        ("term", beacon.term, 8),
    ]
    if beacon.master_time is not None:
        fields.append(("master_time.tx_subticks_master", beacon.master_time.tx_subticks_master, 48))
    relayed = [("master_heard", beacon.master_heard)] if beacon.master_heard is not None else []
    relayed += [(f"heard[{number}]", entry) for number, entry in enumerate(beacon.heard)]
    for name, entry in relayed:
        fields.append((f"{name}.anchor", entry.anchor, 16))
        fields.append((f"{name}.sequence", entry.sequence, 8))
        fields.append((f"{name}.rx_ticks", entry.rx_ticks, 40))
    for name, value, bits in fields:
        if not isinstance(value, SupportsIndex) or not 0 <= index(value) < 1 << bits:
            return f"{name} is {value!r}; it must be a whole number of {bits} bits, 0 to {(1 << bits) - 1}"
    return "a field of the beacon has the wrong type"


# The schedule of protocol 1: the superframe and its slots.
#
# The RMARKER of a frame lies at the start of its slot on the master's scale, which counts from the start of
# superframe 0. So a frame's preamble is sent in the last 138 µs of the slot before.


class Schedule(Struct, frozen=True, gc=False):
    """A superframe of equal slots; each node has ``frames_per_node`` of them, as far apart as can be."""

    slot_ticks: int
    slots: int
    frames_per_node: int = 1

    @property
    def superframe_ticks(self) -> int:
        """Length of the superframe on the master's scale."""
        return self.slot_ticks * self.slots

    @property
    def superframe_rate_hz(self) -> float:
        """Superframes per second."""
        return TICK_RATE_HZ / self.superframe_ticks

    def messages_per_s(self, nodes: int) -> float:
        """Frames per second of that many nodes, each of them one update for a tag that is updated by each message."""
        return nodes * self.frames_per_node * self.superframe_rate_hz

    def slots_of(self, first_slot: int) -> tuple[int, ...]:
        """Slots of a node, ascending: its first and every ``slots // frames_per_node`` after it, modulo slots."""
        spacing = self.slots // self.frames_per_node
        return tuple(sorted((first_slot + frame * spacing) % self.slots for frame in range(self.frames_per_node)))

    def slot_start_ticks(self, superframe: int, slot: int) -> int:
        """RMARKER of that slot's frame, in master ticks since the start of superframe 0 (unwrapped)."""
        return superframe * self.superframe_ticks + slot * self.slot_ticks

    def round_of(self, superframe: int, slot: int) -> int:
        """Round of a frame; in each round every node sends once: the superframe, or its share with several frames.

        Slots beyond the last whole share (``slots`` no multiple of the frames per node) count to the last one.
        """
        share = min(slot // (self.slots // self.frames_per_node), self.frames_per_node - 1)
        return superframe * self.frames_per_node + share

    def next_slot(self, ticks_master: int, slots: tuple[int, ...]) -> tuple[int, int]:
        """Superframe and slot of a node's first frame at or after a time, given its slots in ascending order.

        ``ticks_master`` counts from the start of superframe 0 (unwrapped). ``slots`` must not be empty.
        """
        superframe, into_ticks = divmod(ticks_master, self.superframe_ticks)
        for slot in slots:
            if slot * self.slot_ticks >= into_ticks:
                return superframe, slot
        return superframe + 1, slots[0]


def schedule_from_page(page: SchedulePage) -> Schedule:
    """Return the schedule that a page of the almanac describes."""
    return Schedule(page.slot_ticks, page.slots, page.frames_per_node)


def schedule_of(site: Site) -> Schedule:
    """Return the schedule of a validated site of protocol 1, its slot rounded to steps of the delayed transmission."""
    plan = site.schedule
    slots = len(site.anchors) * plan.frames_per_node if plan.slots is None else plan.slots
    return Schedule(_slot_ticks(site), slots, plan.frames_per_node)


def _slot_ticks(site: Site) -> int:
    steps = round(site.schedule.slot_s * TICK_RATE_HZ / DELAYED_TX_GRANULARITY_TICKS)
    return steps * DELAYED_TX_GRANULARITY_TICKS


def first_slots(site: Site) -> dict[int, int]:
    """Return the first slot of each anchor, in the order of the site file.

    Anchors without a slot of their own get the lowest free ones: the master first, then in the order of the file.

    Raises:
        ValueError: two anchors would share a slot, an anchor's slot is outside the superframe, or no slot is left; the
            message names the anchor and the key.
    """
    schedule = schedule_of(site)
    given = [anchor for anchor in site.anchors if anchor.slot is not None]
    others = [anchor for anchor in site.anchors if anchor.slot is None]
    others.sort(key=lambda anchor: anchor.id != site.master)
    first: dict[int, int] = {}
    taken: set[int] = set()
    for anchor in given + others:
        slot = anchor.slot
        if slot is None:
            slot = next((one for one in range(schedule.slots) if taken.isdisjoint(schedule.slots_of(one))), None)
        if slot is None or not 0 <= slot < schedule.slots or not taken.isdisjoint(schedule.slots_of(slot)):
            raise ValueError(_no_slot(anchor.id, slot, schedule))
        taken.update(schedule.slots_of(slot))
        first[anchor.id] = slot
    return {anchor.id: first[anchor.id] for anchor in site.anchors}


def _no_slot(anchor: int, slot: int | None, schedule: Schedule) -> str:
    if slot is None:
        needed = f"schedule.slots is {schedule.slots} with {schedule.frames_per_node} frames per node"
        return f"anchor {anchor} finds no free slot; {needed}, and more slots are needed"
    return (
        f"anchor {anchor}: slot is {slot}; it must be from 0 to {schedule.slots - 1}, "
        "and none of the anchor's frames may fall on another anchor's"
    )
