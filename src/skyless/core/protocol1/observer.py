"""Observations out of beacons of protocol 1: rounds, and the master's time along the tag's own."""

from skyless.core.air.frame import Heard
from skyless.core.constants import TICK_M
from skyless.core.kernels.arrays import Array
from skyless.core.observation import MasterTerm, Observation
from skyless.core.protocol1.beacon import Beacon
from skyless.core.protocol1.codec import packed_relays
from skyless.core.protocol1.master_term import master_term_of
from skyless.core.protocol1.schedule import Schedule
from skyless.core.ticks import FLIGHT_SLACK_TICKS, may_elapse, nearest


class Observer:
    """What a tag must remember of beacons to make observations of those that follow."""

    def __init__(self) -> None:
        self._needs_relays = False
        self._schedule: Schedule | None = None
        self._master: int | None = None
        self._master_slot = 0
        self.scale: tuple[int, int] | None = None
        """The master's time and the tag's, both unwrapped, when they were compared last."""

    def forget(self) -> None:
        """Start again."""
        self.scale = None

    def set_master(self, master: int | None, master_slot: int) -> None:
        """Refer rounds to this master, whose first slot in the superframe is given."""
        self._master, self._master_slot = master, master_slot

    def set_method(self, schedule: Schedule, *, needs_relays: bool) -> None:
        """Make observations with relays and the master's term, or with rounds and stamps of the master's frames."""
        self._schedule, self._needs_relays = schedule, needs_relays

    def observe(
        self,
        frame: bytes,
        beacon: Beacon,
        anchor_m: Array,
        rx_ticks: int,
        tx_ticks: int,
        rx_variance_factor: float,
        master_term: MasterTerm | None,
    ) -> Observation:
        """One observation of a beacon in a frame; ``master_term``, that of the receiver, is mostly the beacon's too."""
        ticks_master, fraction, variance_m2 = self._master_time(beacon, rx_ticks)
        if not self._needs_relays:
            heard = beacon.master_heard if beacon.master == self._master else None
            master_sequence, master_rx_ticks = _stamp_of(heard, tx_ticks)
            return Observation(
                beacon.anchor, anchor_m, self._round(beacon), beacon.sequence, rx_ticks, tx_ticks, master_sequence,
                master_rx_ticks, ticks_master, fraction, variance_m2, (), None, rx_variance_factor,
            )  # fmt: skip
        if ticks_master is None:
            master_term = None
        elif master_term is None or master_term.master != beacon.master or master_term.term != beacon.term:
            master_term = master_term_of(beacon)
        return Observation(
            beacon.anchor, anchor_m, 0, beacon.sequence, rx_ticks, tx_ticks, None, None, ticks_master, fraction,
            variance_m2, (), master_term, rx_variance_factor, packed_relays(frame, beacon),
        )  # fmt: skip

    def _round(self, beacon: Beacon) -> int:
        """Round of a frame, counted from the master's slot: what follows a frame of the master refers to it."""
        schedule = self._schedule
        assert schedule is not None
        superframe, slot = beacon.superframe, beacon.slot - self._master_slot
        if not 0 <= slot < schedule.slots:
            steps, slot = divmod(slot, schedule.slots)
            superframe += steps
        return superframe if schedule.frames_per_node == 1 else schedule.round_of(superframe, slot)

    def _master_time(self, beacon: Beacon, rx_ticks: int) -> tuple[int | None, float, float]:
        """TX time on the master's scale: unwrapped whole ticks, fraction, variance in m².

        Only the master, and anchors that agree with what was received before, continue the scale.
        """
        time, scale = beacon.master_time, self.scale
        if time is None:
            return None, 0.0, 0.0
        subticks = time.tx_subticks_master
        whole = subticks >> 8
        updates = scale is None or beacon.anchor == self._master
        if scale is not None:
            elapsed = rx_ticks - scale[1]
            whole = nearest(whole, scale[0] + elapsed)
            updates = updates or may_elapse(whole - scale[0], elapsed, FLIGHT_SLACK_TICKS)
        if updates:
            self.scale = (whole, rx_ticks)
        return whole, (subticks & 0xFF) / 256.0, (time.std_ticks * TICK_M) ** 2


def _stamp_of(heard: Heard | None, tx_ticks: int) -> tuple[int, int] | tuple[None, None]:
    """Sequence number and unwrapped RX stamp of what the sender of a beacon received before that."""
    return (None, None) if heard is None else (heard.sequence, nearest(heard.rx_ticks, tx_ticks))
