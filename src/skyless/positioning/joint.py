"""``joint``: the tag's motion and all anchors' clocks in one filter, fed from raw stamps (``docs/maths.md`` section 6).

The same kernels serve message by message (``JointFilter.hear``) and over arrays (``JointFilter.track``).
"""

import struct
from collections.abc import Callable, Iterable
from functools import cache
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.addresses import Addresses
from skyless.air.beacon import HEARD
from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_S
from skyless.positioning.fix_rows import PROTECTED_ROWS
from skyless.positioning.joint_hearing import FULL, JOINED, joint_motion, joint_track
from skyless.positioning.joint_state import (
    BASE,
    CAUTION,
    EPOCH,
    EXCLUDED,
    EXCLUSIONS,
    LATE_SHARE,
    QA,
    REJECTED_IN_ROW,
    RELAYS_REFUSED,
    RELAYS_TAKEN,
    RX_VARIANCE,
    SITE,
    SLOTS,
    STALE_IN_ROW,
    TX_VARIANCE,
    WEIGHT,
    WHOLE,
    Integers,
    JointArrays,
    Matrix,
    Vector,
    extended,
    new_arrays,
    states,
    values,
)
from skyless.positioning.joint_step import MOST_PACKED, PACKET, Exchanged, joint_rest, joint_step
from skyless.positioning.joint_sync import NO_SYNCS
from skyless.positioning.joint_time import move_base
from skyless.positioning.kalman import horizontal_variance
from skyless.positioning.protection import RISK, limits_of
from skyless.positioning.protection_levels import LEVELS
from skyless.positioning.tracker import AGILITY, LOST_IN_ROW, LOST_SHARE, REJECTED_SHARE

MAX_RATE: Final = 50e-6
"""Two crystals of ±20 ppm, and room."""

DOUBTFUL_SHARE: Final = 0.12
"""Of messages beyond the gate; in the first second after a start."""


CONTRADICTIONS: Final = 4.0
"""Relayed receptions beyond the gate lately; fewer may be late ones."""


class JointSettings(Struct, frozen=True):
    """What the filter assumes."""

    qa: float = 0.5
    """Spectral density of the acceleration, m²/s³ per axis."""
    white: float = 3.6e-5
    """Of each oscillator, m²/s."""
    walk: float = 0.09
    """Of each oscillator's rate, m²/s³."""
    tx_variance_m2: float = 9e-4
    rx_variance_m2: float = 9e-4
    """Of one stamp each."""
    gate: float = 4.0
    """Innovations beyond so many standard deviations are not used."""
    height_m: float | None = None
    """Height of the tag where it is given; None to estimate it."""
    drop_s: float = 2.0
    """Anchors that are silent for longer are out of view."""
    integrity_risk: float = RISK
    """Probability, for each fix, that an error exceeds its protection level."""
    alert_limit_m: float | None = None
    """Fixes with a higher horizontal protection level say so."""

    @property
    def dim(self) -> int:
        """Dimensions of the position that are estimated."""
        return 3 if self.height_m is None else 2

    def array(self) -> Vector:
        """The settings as the kernels take them."""
        height_m = 0.0 if self.height_m is None else self.height_m
        rate_variance = (MAX_RATE * SPEED_OF_LIGHT_MPS) ** 2
        stamps = (self.tx_variance_m2, self.rx_variance_m2)
        return np.array(
            [self.dim, self.qa, self.white, self.walk, *stamps, self.gate, height_m, rate_variance, self.drop_s]
        )


class Messages(Struct, frozen=True):
    """Packets in the order in which the tag heard them, all stamps unwrapped."""

    sites: Integers
    """Place of each packet's anchor in the table of positions, shape (n,)."""
    sequences: Integers
    rx_ticks: Integers
    """The tag's stamps."""
    tx_ticks: Integers
    """The anchors' own."""
    relays: Integers
    """As ``joint_hear`` takes them, shape (relays, 4)."""
    ends: Integers
    """Where the relays of each packet end."""
    syncs: Matrix = NO_SYNCS
    """What each packet's anchor says of its clock, as ``joint_hear`` takes it, shape (n, 3), or (0, 3) for nothing."""


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
        old, dim = self.arrays, self.dim
        s = new_arrays(old.settings, len(old.slots), len(old.site_m))
        self._use(s, self._exchanged)
        s.site_m[:] = old.site_m
        s.x[:dim] = position_m
        s.P[:dim, :dim] = covariance_m2
        s.P[range(dim, 2 * dim), range(dim, 2 * dim)] = speed_variance
        s.counts[EPOCH] = s.counts[BASE] = rx_ticks
        s.statistics[:] = 0.0
        s.statistics[CAUTION] = caution_m2
        s.statistics[:4] = (1.0, s.settings[TX_VARIANCE] + s.settings[RX_VARIANCE], 0.0, 1.0)

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
        if self._addresses is None:
            self._addresses = Addresses((*self._arrays, *self._exchanged))
        status = joint_step(self._addresses.table)
        if status == FULL:
            self._extend()
            return self._step()
        return status

    def _weighed_step(self, site: int, variance_factor: float) -> int:
        self._weigh(site, variance_factor)
        status = self._step()
        self._weigh(site, 1.0)
        if status == JOINED:
            self._doubt(site, variance_factor)
        return status

    def _weigh(self, site: int, variance_factor: float) -> None:
        """Set the factor on the variance of the tag's receptions of an anchor, if it is in view."""
        s = self.arrays
        if s.slot_of[site] >= 0:
            s.anchors[s.slot_of[site], WEIGHT] = variance_factor

    def _doubt(self, site: int, variance_factor: float) -> None:
        """Let the offset of an anchor that has just joined be as uncertain as the reception that it rests on."""
        s = self.arrays
        place = self.dim + int(s.slot_of[site])
        s.P[place, place] += (variance_factor - 1.0) * (s.settings[TX_VARIANCE] + s.settings[RX_VARIANCE])

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

    def covariance(self) -> Matrix:
        """Of all states in use, at the newest message."""
        s = JointArrays._make(array.copy() for array in self.arrays)
        move_base(s, int(s.counts[EPOCH]))
        n = states(s)
        return s.P[:n, :n]

    def motion(self) -> tuple[Vector, Matrix]:
        """Position and velocity at the newest message, and their covariance; overwritten by the next call."""
        joint_motion(self.arrays, *self.newest)
        return self.newest

    @property
    def lost(self) -> bool:
        """Whether so many messages do not fit that the state must be wrong."""
        in_row = self.arrays.counts[REJECTED_IN_ROW] + self.arrays.counts[STALE_IN_ROW]
        late = min(self.arrays.statistics[LATE_SHARE], 0.45)
        return bool(self.arrays.statistics[REJECTED_SHARE] > LOST_SHARE or in_row * (1.0 - 2.0 * late) >= LOST_IN_ROW)

    @property
    def is_contradicted(self) -> bool:
        """Whether most of what anchors heard of each other does not fit: a wrong place draws all clocks with it."""
        recent = self._arrays.recent
        refused: float = recent.item(RELAYS_REFUSED)
        return refused > CONTRADICTIONS and refused > float(recent.item(RELAYS_TAKEN))

    @property
    def relays_fit(self) -> bool:
        """Whether most of what anchors heard of each other fits, and that is more than a few receptions."""
        recent = self._arrays.recent
        taken = recent.item(RELAYS_TAKEN)
        return bool(taken > max(CONTRADICTIONS, 4.0 * recent.item(RELAYS_REFUSED)))

    @property
    def is_doubtful(self) -> bool:
        """Whether more messages do not fit than a sound start leaves."""
        s = self.arrays
        return bool(s.statistics[REJECTED_SHARE] > DOUBTFUL_SHARE or s.counts[EXCLUSIONS] > 0)

    def excluded(self) -> list[int]:
        """Places in the table of the anchors that are heard but not used."""
        slots = self.arrays.slots[: self.arrays.counts[SLOTS]]
        places: list[int] = slots[slots[:, EXCLUDED] != 0, SITE].tolist()
        return places

    def horizontal_variance_m2(self, ahead_s: float) -> float:
        """Sum of the variances of x and y so much later, if nothing is heard until then."""
        s = self.arrays
        _, covariance = self.motion()
        return horizontal_variance(covariance, self.dim, ahead_s, s.settings[QA] * s.statistics[AGILITY])

    def clock(self, site: int) -> tuple[int, float, float] | None:
        """The tag's clock against that of an anchor in view: whole ticks, the rest in metres, rate in m/s."""
        s = self.arrays
        slot = int(s.slot_of[site])
        if slot < 0:
            return None
        half, place = values(s), self.dim + slot
        tau_s = (int(s.counts[EPOCH]) - int(s.counts[BASE])) * TICK_S
        rate = float(s.x[half + place])
        return int(s.slots[slot, WHOLE]), float(s.x[place]) + tau_s * rate, rate
