"""The schedule of protocol 1: the superframe and its slots.

The RMARKER of a frame lies at the start of its slot on the master's scale, which counts from the start of superframe 0.
So a frame's preamble is sent in the last 138 µs of the slot before.
"""

from msgspec import Struct

from skyless.core.air.almanac import SchedulePage
from skyless.core.constants import DELAYED_TX_GRANULARITY_TICKS, TICK_RATE_HZ
from skyless.core.site import Site


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
