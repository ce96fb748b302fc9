"""The estimator of one tag for Python: packet by packet, or many in one compiled loop, with the same bits."""

import ctypes
from collections.abc import Sequence
from math import degrees, hypot, isfinite, sqrt
from typing import Any, Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.core.arrays import Integers, Matrix, Vector
from skyless.core.estimator import compiled
from skyless.core.estimator.compiled import add_anchor, find_anchor, fit_plane, restart
from skyless.core.estimator.faults import horizontal_variance_m2, is_late_often, rejects_most
from skyless.core.estimator.kalman import has_phase
from skyless.core.estimator.motion import GRAVITY_MPS2, heading_std_rad
from skyless.core.estimator.process import REJECTED, BatchPacket, BatchRow, Packet, Place, Relay, Relays
from skyless.core.estimator.settings import TUNING, EstimatorSettings
from skyless.core.estimator.state import ALL_RANGE_ERRORS, State, at, covariances, make_uncertain, new_state
from skyless.core.motion_sample import MotionSample
from skyless.core.native.records import MAX_RELAYS
from skyless.core.native.views import records, view
from skyless.core.ticks import NEVER, TICK_S

_WRONG_TILT: Final = 0.05
"""Error of the level beyond which it is stated [rad]."""

_THREE: Final = ctypes.c_double * 3

MAX_ANCHORS_KNOWN: Final = 256
"""Beyond this number, each new anchor replaces one that is not in the state."""


class Report(Struct, frozen=True, gc=False):
    """An anchor's report of its clock."""

    master: int
    """The master's identifier; −1 for no report."""
    subticks: int
    """The anchor's reading minus the master's at the packet's TX stamp, modulo 2⁴⁸."""
    variance_m2: float


NO_REPORT: Final = Report(-1, 0, 0.0)


class Packets(Struct, frozen=True):
    """Packets in order of reception, with unwrapped stamps."""

    anchors: Integers
    """Identifier of each packet's anchor, shape (n,)."""
    sequences: Integers
    rx_ticks: Integers
    """The tag's stamps."""
    tx_ticks: Integers
    """The anchors' own stamps."""
    relays: Integers
    """[listener, sender, sequence number, RX stamp of the listener], shape (relays, 4)."""
    ends: Integers
    """End of each packet's relays."""
    phases_cycles: Vector | None = None
    """Carrier phases as the tag received them, shape (n,); negative if unknown."""


class Estimator:
    """The filter of one tag."""

    def __init__(self, settings: EstimatorSettings, anchors_m: Matrix | None = None) -> None:
        """``anchors_m``: positions of anchors with identifiers 0, 1, …, shape (n, 3); ``know_anchor`` adds others."""
        self._known: dict[int, tuple[Vector, Place]] = {}
        """Each anchor's position as given, and its place for the filter."""
        self._packet, self._relays = Packet(), Relays()
        self._state = new_state(settings)
        self._motion_late_s = 0.0
        """How late the newest motion sample was."""
        for anchor, position_m in enumerate([] if anchors_m is None else anchors_m):
            self.know_anchor(anchor, position_m)

    @property
    def state(self) -> State:
        """The state."""
        return self._state

    @property
    def settings(self) -> EstimatorSettings:
        """The settings in use."""
        return self._state.settings

    @property
    def dim(self) -> int:
        """Dimensions of the position."""
        return self._state.dim

    @property
    def rows(self) -> bytes:
        """The rows of a fix (``POSITION`` and the following) at the newest packet."""
        fix: Any = self._state.fix
        return bytes(fix)

    # Anchors

    def know_anchor(self, anchor: int, position_m: Vector) -> None:
        """Set an anchor's position before it is used, or after it has moved.

        ``position_m``, shape (3,), counts as unchanged while it is the same array object.
        """
        known = self._known.get(anchor)
        if known is not None and known[0] is position_m:
            return
        if known is None and len(self._known) >= MAX_ANCHORS_KNOWN:  # a tag on its way through a large site
            del self._known[next(one for one in self._known if not self.has_anchor(one))]
        place = Place(anchor=anchor, std_m=-1.0)
        place.position_m[0], place.position_m[1], place.position_m[2] = map(float, position_m)
        self._known[anchor] = position_m, place

    @property
    def known_anchors(self) -> tuple[int, ...]:
        """Identifiers of all anchors whose position is known."""
        return tuple(self._known)

    def has_anchor(self, anchor: int) -> bool:
        """Whether an anchor is in the state."""
        return find_anchor(self._state, anchor) >= 0

    @property
    def anchors(self) -> tuple[int, ...]:
        """Identifiers of the anchors in the state."""
        return tuple(self._state.anchors[index].identifier for index in range(self._state.count))

    def remove_anchor(self, anchor: int) -> None:
        """Remove an anchor from the state, if it is there."""
        compiled.leave(self._state, anchor)

    # Starts

    def expect_late(self, anchor: int, late_m: float, variance_m2: float, may_stay: bool) -> None:
        """Expect an anchor to be ``late_m`` late at the start, with this variance; ``may_stay``: for good, perhaps."""
        s, index = self._state, find_anchor(self._state, anchor)
        if index < 0:
            place = self._known[anchor][1]
            index = add_anchor(s, anchor, place.position_m, place.std_m, place.is_open)
            fit_plane(s)
        change, constant = s.layout.change + index, s.layout.constant + index
        staying_m = late_m if may_stay else 0.0
        s.x[change], s.x[constant] = late_m - TUNING.staying_share * staying_m, TUNING.staying_share * staying_m
        s.P[at(change, change)] += variance_m2
        s.P[at(constant, constant)] += (TUNING.staying_share * staying_m) ** 2
        make_uncertain(s, ALL_RANGE_ERRORS)

    def withhold_levels(self, state: int) -> None:
        """State the levels as ``CONTRADICTED`` or ``UNAVAILABLE`` from now on; ``SOUND``: as the filter finds them."""
        self._state.status.withheld = state

    def start(self, rx_ticks: int, position_m: Vector, covariance_m2: Matrix, speed_variance: float) -> None:
        """Start without anchors at a position, shapes (dim,) and (dim, dim); the share of late packets is kept.

        ``position_m`` may continue with a known velocity, ``covariance_m2`` with its covariance.
        """
        s, dim = self._state, self.dim
        restart(s, rx_ticks, s.status.late_share, TUNING.lasting_std_m, False)
        known = len(position_m)
        view(s.x)[:known] = position_m
        for one in range(known):
            for other in range(known):
                s.P[at(one, other)] = covariance_m2[one, other]
        for axis in range(known, 2 * dim):
            s.P[at(axis, axis)] = speed_variance

    # Measurements

    def hear_motion(self, ticks: int, sample: MotionSample) -> bool:
        """Process a motion sensor's sample at a tag time. Returns False if it is late."""
        rate_rps, force_mps2, speed_mps = _THREE(*sample.rate_rps), sample.force_mps2, sample.speed_mps
        lever = self._state.motion.lever_m
        lever[0], lever[1], lever[2] = sample.arm_m
        self._motion_late_s, is_used = (self._state.status.epoch_ticks - ticks) * TICK_S, False
        if force_mps2 is not None:
            is_used = bool(compiled.hear_motion(self._state, ticks, rate_rps, _THREE(*force_mps2)))
        if speed_mps is not None:
            is_used = bool(compiled.hear_wheels(self._state, ticks, rate_rps, speed_mps))
        return is_used

    def shift_motion(self, ticks: int) -> None:
        """Let the time of motion samples continue on a scale on which the same time is ``ticks`` later."""
        m = self._state.motion
        m.ticks, m.speed_ticks, m.ignored_ticks = m.ticks + ticks, m.speed_ticks + ticks, m.ignored_ticks + ticks

    def process(
        self,
        anchor: int,
        sequence: int,
        rx_ticks: int,
        tx_ticks: int,
        relays: Sequence[tuple[int, int, int]] = (),
        *,
        packed: bytes = b"",
        report: Report = NO_REPORT,
        variance_factor: float = 1.0,
        phase_cycles: float = -1.0,
    ) -> int:
        """Process one packet of a known anchor. Returns the outcome (``ACCEPTED`` …) and leaves ``rows``.

        ``relays``: identifier, sequence number and RX stamp; ``packed``: relays encoded as in frames
        (``beacon.packed_relays``); ``variance_factor``: on the variance of the tag's reception; ``phase_cycles``:
        carrier phase as the tag received it, in [0, 1), negative if unknown.
        """
        given = self.packet_of(anchor, sequence, rx_ticks, tx_ticks, relays, report, variance_factor, phase_cycles)
        return compiled.process_frame(self._state, *given, packed, len(packed))

    def packet_of(
        self,
        anchor: int,
        sequence: int,
        rx_ticks: int,
        tx_ticks: int,
        relays: Sequence[tuple[int, int, int]] = (),
        report: Report = NO_REPORT,
        variance_factor: float = 1.0,
        phase_cycles: float = -1.0,
        relay_phases: Sequence[float] = (),
    ) -> tuple[Packet, Relays]:
        """A packet of a known anchor for compiled functions, in the same memory each time; see ``process``."""
        packet, taken = self._packet, self._relays
        packet.place = self._known[anchor][1]
        packet.sequence, packet.rx_ticks, packet.tx_ticks = sequence, rx_ticks, tx_ticks
        packet.variance_factor = variance_factor
        packet.has_phase, packet.phase_cycles = phase_cycles >= 0.0, phase_cycles
        packet.master, packet.subticks = report.master, report.subticks
        packet.report_variance_m2 = report.variance_m2
        taken.count = min(len(relays), MAX_RELAYS)
        for relayed, (sender, number, stamp) in zip(taken.rows, relays, strict=False):
            relayed.listener, relayed.anchor, relayed.sequence, relayed.rx_ticks = anchor, sender, number, stamp
            relayed.is_short = relayed.has_phase = False
        for relayed, cycles in zip(taken.rows, relay_phases, strict=False):
            relayed.has_phase, relayed.phase_cycles = cycles >= 0.0, cycles
        return packet, taken

    def process_difference(self, a: int, b: int, rx_ticks: int, difference_m: float) -> int:
        """Process a ready-made difference of ranges, to anchor b minus to anchor a, as ``process`` does."""
        if not isfinite(difference_m):
            return REJECTED
        return compiled.process_difference(self._state, self._known[a][1], self._known[b][1], rx_ticks, difference_m)

    def process_height(self, height_m: float, std_m: float, is_barometer: bool = False) -> int:
        """Process a height sensor's reading at the newest packet: ``ACCEPTED`` or ``REJECTED``.

        A barometer's zero, which is unknown and drifts, is estimated; only in three dimensions.
        """
        return compiled.process_height(self._state, height_m, std_m, is_barometer)

    def track(self, packets: Packets, *, has_levels: bool = False) -> NDArray[np.void]:
        """Process many packets in one loop. Returns the state after each, an array of ``BatchRow``, shape (n,)."""
        count = len(packets.anchors)
        identifiers, indices = np.unique(packets.anchors, return_inverse=True)
        places = (Place * len(identifiers))(*(self._known[int(anchor)][1] for anchor in identifiers))
        given, relays = np.zeros(count, np.dtype(BatchPacket)), np.zeros(len(packets.relays), np.dtype(Relay))
        given["place"], given["sequence"], given["end"] = indices, packets.sequences, packets.ends
        given["rx_ticks"], given["tx_ticks"] = packets.rx_ticks, packets.tx_ticks
        given["variance_factor"] = 1.0
        if packets.phases_cycles is not None:
            given["has_phase"], given["phase_cycles"] = packets.phases_cycles >= 0.0, packets.phases_cycles
        for column, name in enumerate(("listener", "anchor", "sequence", "rx_ticks")):
            relays[name] = packets.relays[:, column]
        rows = np.zeros(count, np.dtype(BatchRow))
        columns = records(BatchPacket, given), records(Relay, relays), records(BatchRow, rows)
        compiled.track(self._state, places, *columns, count, has_levels)
        return rows

    # What it knows

    @property
    def multipath_m(self) -> tuple[float, float] | None:
        """Standard deviation and distance of changing range errors, if more than the settings state."""
        status = self._state.status
        variance_m2 = status.place_variance_m2
        return (sqrt(variance_m2), status.place_distance_m) if variance_m2 > 0.0 else None

    @property
    def is_late_often(self) -> bool:
        """Whether single packets are late often."""
        return is_late_often(self._state)

    @property
    def rejects_most(self) -> bool:
        """Whether most measurements are beyond the gate."""
        return rejects_most(self._state)

    @property
    def obstructed(self) -> tuple[int, ...]:
        """Anchors whose range error has jumped and stayed, or that have a lasting fault."""
        anchors = (self._state.anchors[index] for index in range(self._state.count))
        return tuple(one.identifier for one in anchors if one.is_obstructed or one.has_fault)

    @property
    def phase_anchors(self) -> tuple[int, ...]:
        """Anchors whose carrier phases are in use."""
        s = self._state
        return tuple(sorted(s.anchors[index].identifier for index in range(s.count) if has_phase(s, index)))

    def position_m(self) -> Vector:
        """The position at the newest packet, shape (dim,)."""
        return view(self._state.x)[: self.dim].copy()

    def motion(self) -> tuple[Vector, Matrix]:
        """Position and velocity at the newest packet, shape (2·dim,), and their covariance."""
        dim, velocity = self.dim, self._state.layout.velocity
        states = [*range(dim), *range(velocity, velocity + dim)]
        return view(self._state.x)[states], covariances(self._state)[np.ix_(states, states)]

    @property
    def motion_note(self) -> str | None:
        """What keeps a motion sensor from being used fully, in a sentence; None if nothing does, or there is none."""
        s, m = self._state, self._state.motion
        silent_s = (s.status.epoch_ticks - max(m.ticks, m.speed_ticks)) * TICK_S
        if m.samples == 0:
            return None
        if abs(silent_s) > TUNING.longest_gap_s:
            why = "have ended"
            if self._motion_late_s > TUNING.longest_gap_s:
                why = f"come {self._motion_late_s:.1f} s late"
            elif silent_s < 0.0:
                why = f"are {-silent_s:.1f} s ahead of the receptions"
            return f"The motion sensor's samples {why}: they are not used"
        if not m.is_level:
            return "The motion sensor's level is being found"
        if not m.has_effect and m.ignored_ticks - s.status.epoch_ticks > 0:
            return "The motion sensor contradicts the positions: it is ignored for a while (time, axes, mounting?)"
        error = s.layout.acceleration
        if heading_std_rad(s) < 0.0:
            why = ", as the sensor has contradicted the positions" if m.contradictions else ""
            return f"The motion sensor's heading is not known yet{why}: move by some 3 m, or turn"
        tilt = hypot(s.x[error], s.x[error + 1]) / GRAVITY_MPS2
        return f"The motion sensor's level is off by {degrees(tilt):.0f}°" if tilt > _WRONG_TILT else None

    def horizontal_variance_m2(self, ahead_s: float) -> float:
        """Sum of the variances of x and y after ``ahead_s`` without receptions."""
        return horizontal_variance_m2(self._state, ahead_s)

    def clock(self, anchor: int) -> tuple[int, float, float] | None:
        """Tag's clock minus an anchor's: whole ticks, the rest in m, rate in m/s. None if it is not in the state."""
        s, index = self._state, find_anchor(self._state, anchor)
        if index < 0 or s.anchors[index].rx_ticks == NEVER:
            return None
        return s.anchors[index].offset_ticks, s.x[s.layout.offset + index], s.x[s.layout.rate + index]
