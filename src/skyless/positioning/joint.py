"""``joint``: the tag's motion and all anchors' clocks in one filter, fed from raw stamps (``docs/maths.md`` section 6).

The same kernels serve message by message (``JointFilter.hear``) and over arrays (``JointFilter.track``).
"""

import struct
from collections.abc import Callable, Iterable
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyless.addresses import Addresses
from skyless.air.beacon import HEARD
from skyless.positioning.fix_rows import PROTECTED_ROWS
from skyless.positioning.joint_hearing import FULL, JOINED, joint_motion, joint_track
from skyless.positioning.joint_messages import Messages
from skyless.positioning.joint_settings import JointSettings
from skyless.positioning.joint_state import (
    QA,
    Integers,
    JointArrays,
    Matrix,
    Vector,
    doubt,
    extended,
    new_arrays,
    started,
    weigh,
)
from skyless.positioning.joint_step import MOST_PACKED, PACKET, Exchanged, joint_rest, joint_step
from skyless.positioning.joint_sync import NO_SYNCS
from skyless.positioning.kalman import horizontal_variance
from skyless.positioning.protection import limits_of
from skyless.positioning.protection_levels import LEVELS
from skyless.positioning.tracker import AGILITY

NO_SYNC: Final = (0.0, 0.0, 0.0)

LAST_NAME: Final = 0xFFFF
NO_RELAYS: Final = np.empty((0, 4), np.int64)

_pack_packet: Final[Callable[..., None]] = PACKET.pack_into


@cache
def _packing(count: int) -> Callable[..., None]:
    return struct.Struct(f"{count}q").pack_into


class JointFilter:
    """State of one tag."""

    def __init__(self, settings: JointSettings, site_m: NDArray[np.float64], capacity: int = 8) -> None:
        """``site_m``: positions of the anchors, shape (n, 3); ``capacity``: how many may be in view, to begin with."""
        self._arrays = new_arrays(settings.array(), capacity, max(len(site_m), capacity))
        self._arrays.site_m[: len(site_m)] = site_m
        self.dim = settings.dim
        self._anchors = len(site_m)
        self._exchanged = Exchanged(
            packet=np.zeros(PACKET.size // 8, np.int64),
            names=np.full(len(self.arrays.site_m), -1),
            relays=np.zeros((MOST_PACKED, 4), np.int64),
            sync=np.zeros((1, 3)),
            motion=np.zeros(2 * self.dim),
            covariance=np.zeros((2 * self.dim, 2 * self.dim)),
            rows=np.zeros((PROTECTED_ROWS, 3)),
            limits=limits_of(settings.integrity_risk),
            levels=np.zeros(LEVELS),
        )
        self._addresses: Addresses | None = None

    def add_anchor(self, anchor_m: Vector, name: int = -1) -> int:
        """Add an anchor to the table; returns its place there. ``name``: by which packed relays call it, 16 bits."""
        place, s = self._anchors, self.arrays
        if place == len(s.site_m):
            s = extended(s, len(s.slots), 2 * place)
            names = np.append(self._exchanged.names, np.full(place, -1))
            self._use(s, self._exchanged._replace(names=names))
        s.site_m[place] = anchor_m
        self._exchanged.names[place] = name if 0 <= name <= LAST_NAME else -1
        self._anchors += 1
        return place

    @property
    def arrays(self) -> JointArrays:
        """All states, and what the kernels remember; others after a start, and when there are more anchors."""
        return self._arrays

    def _use(self, arrays: JointArrays, exchanged: Exchanged) -> None:
        """Use other arrays from now on."""
        self._arrays, self._exchanged, self._addresses = arrays, exchanged, None

    def has_anchors(self, places: Iterable[int]) -> bool:
        """Whether these places in the table are taken."""
        return all(type(place) is int and 0 <= place < self._anchors for place in places)

    def move_anchor(self, place: int, anchor_m: Vector) -> None:
        """Correct an anchor's position."""
        s = self.arrays
        s.site_m[place] = anchor_m
        if s.slot_of[place] >= 0:
            s.anchors[s.slot_of[place], :3] = anchor_m

    def start(
        self, rx_ticks: int, position_m: Vector, covariance_m2: Matrix, speed_variance: float, caution_m2: float = 0.0
    ) -> None:
        """Begin at a position, shapes (dim,) and (dim, dim), without any anchor in view.

        ``caution_m2``: additional variance of the first receptions, where many may be late.
        """
        s = started(self.arrays, rx_ticks, position_m, covariance_m2, speed_variance, caution_m2)
        self._use(s, self._exchanged)

    def hear(
        self,
        site: int,
        sequence: int,
        rx_ticks: int,
        tx_ticks: int,
        relays: Integers = NO_RELAYS,
        syncs: Matrix = NO_SYNCS,
        variance_factor: float = 1.0,
    ) -> int:
        """Take one packet (``joint_hear``); leaves what ``motion`` returns in ``newest``.

        ``variance_factor``: on the variance of the tag's reception of it, not of those that it relays.
        """
        self._make_room(len(relays))
        told = self._exchanged
        told.relays[: len(relays)] = relays
        told.sync[: len(syncs)] = syncs
        _pack_packet(told.packet, 0, site, sequence, rx_ticks, tx_ticks, len(syncs), len(relays), 0, 0, 0, 0.0, b"")
        return self._step() if variance_factor == 1.0 else self._weighed_step(site, variance_factor)

    def _make_room(self, relays: int) -> None:
        if relays + MOST_PACKED > len(self._exchanged.relays):
            rows = np.zeros((relays + MOST_PACKED, 4), np.int64)
            self._use(self._arrays, self._exchanged._replace(relays=rows))

    def hear_listed(
        self,
        site: int,
        sequence: int,
        rx_ticks: int,
        tx_ticks: int,
        relays: list[int],
        packed: bytes = b"",
        master: int = 0,
        sync_variance_m2: float = 0.0,
        variance_factor: float = 1.0,
    ) -> int:
        """As ``hear``, rows of relays one after the other in a list, or packed: that spares an array for each packet.

        ``packed`` has the relays as frames carry them (``codec.packed_relays``), anchors by the names that
        ``add_anchor`` was given; ``master`` is one, whose clock the packet's anchor knows with ``sync_variance_m2``.
        What it says of that clock is asked for with ``SYNC_WANTED``: then ``synchronise`` must follow.
        """
        count = len(relays) // 4
        if relays:
            self._make_room(count)
            _packing(len(relays))(self._exchanged.relays, 0, *relays)
        packet, words = self._exchanged.packet, len(packed) // HEARD.size
        _pack_packet(
            packet, 0, site, sequence, rx_ticks, tx_ticks, 0, count, words, master, 0, sync_variance_m2, packed
        )  # fmt: skip
        return self._step() if variance_factor == 1.0 else self._weighed_step(site, variance_factor)

    def synchronise(self, sync: tuple[float, float, float] | None) -> int:
        """Take what an anchor says of its clock, a row of ``Messages.syncs``, or None; returns what ``hear`` does."""
        assert self._addresses is not None
        self._exchanged.sync[0] = NO_SYNC if sync is None else sync
        return joint_rest(self._addresses.table)

    def _step(self) -> int:
        """Take the packet that has been written."""
        addresses = self._addresses
        if addresses is None:
            addresses = self._addresses = Addresses((*self._arrays, *self._exchanged))
        status = joint_step(addresses.table)
        if status == FULL:
            self._extend()
            return self._step()
        return status

    def _weighed_step(self, site: int, variance_factor: float) -> int:
        weigh(self._arrays, site, variance_factor)
        status = self._step()
        weigh(self._arrays, site, 1.0)
        if status == JOINED:
            doubt(self._arrays, site, variance_factor)
        return status

    @property
    def newest(self) -> tuple[Vector, Matrix]:
        """What ``motion`` returns, as of the last packet that ``hear`` took."""
        return self._exchanged.motion, self._exchanged.covariance

    @property
    def rows(self) -> Matrix:
        """What fixes carry (``fix_rows``), as of the last packet that ``hear`` took."""
        return self._exchanged.rows

    @property
    def levels(self) -> Vector:
        """What ``protect`` said of the last packet that ``hear`` took."""
        return self._exchanged.levels

    def track(self, messages: Messages, motions: Matrix | None = None, variances: Matrix | None = None) -> None:
        """Take many packets in one loop; the arithmetic is that of ``hear``, so the states are its, bit for bit.

        Rows of ``motions``, shape (n, 2·dim), and ``variances``, shape (n, dim·dim), are filled in after each packet.
        """
        nothing = np.empty((0, 0))
        done = 0
        while True:
            done = joint_track(
                self.arrays,
                done,
                messages.sites,
                messages.sequences,
                messages.rx_ticks,
                messages.tx_ticks,
                messages.relays,
                messages.ends,
                messages.syncs,
                self._exchanged.motion,
                self._exchanged.covariance,
                nothing if motions is None else motions,
                nothing if variances is None else variances,
            )
            if done == len(messages.sites):
                return
            self._extend()

    def _extend(self) -> None:
        old = self._arrays
        self._use(extended(old, 2 * len(old.slots), len(old.site_m)), self._exchanged)

    def motion(self) -> tuple[Vector, Matrix]:
        """Position and velocity at the newest message, and their covariance; overwritten by the next call."""
        joint_motion(self.arrays, *self.newest)
        return self.newest

    def horizontal_variance_m2(self, ahead_s: float) -> float:
        """Sum of the variances of x and y so much later, if nothing is heard until then."""
        s = self.arrays
        _, covariance = self.motion()
        return horizontal_variance(covariance, self.dim, ahead_s, s.settings[QA] * s.statistics[AGILITY])
