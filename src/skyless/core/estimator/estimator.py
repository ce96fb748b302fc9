"""The estimator at work: packet by packet (``process``), or many in one compiled loop (``track``), with the same bits.

Anchors join and leave between packets, in NumPy; everything else is one kernel a packet.
"""

from collections.abc import Iterable, Sequence
from typing import Annotated, Final

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from skyless.core.air.frame import HEARD
from skyless.core.constants import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.core.estimator.faults import fade_faults, open_faults
from skyless.core.estimator.kalman import is_stationary, predict
from skyless.core.estimator.levels import FIRST_TEST, LEVELS, fit_plane, integrity_state, protect
from skyless.core.estimator.measurements import (
    CLOCK_JUMPED,
    difference,
    first_reception,
    height,
    own_reception,
    relay,
    report,
    zero_velocity,
)
from skyless.core.estimator.monitor import covariance_scale, update_stationary
from skyless.core.estimator.settings import TUNING, EstimatorSettings
from skyless.core.estimator.state import (
    ALL_RANGE_ERRORS,
    LASTING,
    NEVER,
    PACKETS_KEPT,
    EstimatorState,
    layout,
    new_state,
    packed_state,
    unpacked_state,
    with_anchor,
    with_table,
    without_anchor,
)
from skyless.core.fix import POSITION, PROTECTED_ROWS, PROTECTION, QUALITY, VELOCITY
from skyless.core.integrity import HPL, VPL
from skyless.core.kernels.arrays import Indices, Integers, Matrix, Records, Vector
from skyless.core.kernels.compiled import kernel, step, threaded_kernel
from skyless.core.ticks import HALF_WRAP_TICKS, TICK_MASK

REJECTED, ACCEPTED, JOINED, STALE, NEW_ANCHOR, SILENT_ANCHOR, RESTARTED_CLOCK = range(7)
"""What became of a packet; the last three require an anchor to join or leave, and for the packet again."""

MAX_RATE_MPS: Final = 100e-6 * SPEED_OF_LIGHT_MPS  # between two clocks that are still crystals
MAX_PACKED: Final = 16  # relays in a frame; 13 fit


class Report(Struct, frozen=True, gc=False):
    """What an anchor reports of its clock."""

    master: int
    """The master's index in the table; −1 where nothing is reported."""
    subticks: int
    """The anchor's reading less the master's at the packet's TX stamp, modulo 2⁴⁸."""
    variance_m2: float


NO_REPORT: Final = Report(-1, 0, 0.0)


class Packets(Struct, frozen=True):
    """Packets in the order in which the tag received them, all stamps unwrapped."""

    anchors: Integers
    """Index of each packet's anchor in the table, shape (n,)."""
    sequences: Integers
    rx_ticks: Integers
    """The tag's stamps."""
    tx_ticks: Integers
    """The anchors' own."""
    relays: Integers
    """[listener, sender, sequence number, RX stamp of the listener], shape (relays, 4)."""
    ends: Integers
    """Where the relays of each packet end."""


@step
def _silent_anchor(s: EstimatorState, rx_ticks: int) -> int:
    """An anchor that has been silent for too long, or −1."""
    longest, silent = s.settings[0]["drop_s"], -1
    for anchor in range(len(s.anchors)):
        a = s.anchors[anchor]
        if silent < 0 and a["packets"] > 0 and (rx_ticks - a["rx_ticks"]) * TICK_S > longest:
            silent = anchor
    return silent


@step
def _is_impossible(s: EstimatorState, anchor: int, rx_ticks: int, tx_ticks: int) -> bool:
    """Whether no clock can have gone from an anchor's newest packet to this one."""
    settings = s.settings[0]
    a = s.anchors[anchor]
    elapsed = rx_ticks - a["rx_ticks"]
    change_m = abs(elapsed - (tx_ticks - a["tx_ticks"])) * TICK_M
    return bool(change_m > settings["restart_m"] + MAX_RATE_MPS * elapsed * TICK_S)


@kernel
def _process(
    s: EstimatorState,
    table_index: int,
    sequence: int,
    rx_ticks: int,
    tx_ticks: int,
    relays: Integers,
    first: int,
    last: int,
    master: int,
    subticks: int,
    report_variance_m2: float,
    variance_factor: float,
) -> int:
    """Process one packet and what it relays, rows ``first`` to ``last``; what became of it."""
    settings = s.settings[0]
    status, anchor = s.status[0], s.index_of[table_index]
    outcome = _admit(s, anchor, rx_ticks, tx_ticks)
    joins, was_known = outcome == JOINED, outcome == ACCEPTED
    elapsed_s = (rx_ticks - status["epoch_ticks"]) * TICK_S
    if joins or was_known:
        status["stale_in_row"] = 0
        predict(s, rx_ticks)
        fade_faults(s)
        if joins:
            first_reception(s, anchor, rx_ticks, tx_ticks)
        else:
            result = own_reception(s, anchor, rx_ticks, tx_ticks, variance_factor)
            outcome = RESTARTED_CLOCK if result == CLOCK_JUMPED else ACCEPTED if result == 1 else REJECTED
            was_known = result != CLOCK_JUMPED
    if joins or was_known:
        status["packets"] += 1
        _keep_packet(s, anchor, sequence, rx_ticks, tx_ticks)
    if was_known:
        status["relays_lately_accepted"] *= 1.0 - settings["mean_gain"]
        status["relays_lately_rejected"] *= 1.0 - settings["mean_gain"]
    _process_relays(s, relays, first, last if was_known else first)
    if was_known and report_variance_m2 > 0.0 and master >= 0 and s.index_of[master] not in (-1, anchor):
        report(s, anchor, s.index_of[master], subticks, report_variance_m2)
    if joins or was_known:
        _check_motion_and_faults(s, elapsed_s)
    s.status[0]["outcome"] = outcome
    return outcome


@step
def _check_motion_and_faults(s: EstimatorState, elapsed_s: float) -> None:
    """Check whether the tag stands still and, once in a round of packets, for faults."""
    if s.settings[0]["stationary_s"] > 0.0:
        update_stationary(s, elapsed_s)
        if is_stationary(s):
            zero_velocity(s)
    if s.status[0]["packets"] % len(s.anchors) == 0:
        open_faults(s)


@step
def _admit(s: EstimatorState, anchor: int, rx_ticks: int, tx_ticks: int) -> int:
    """``JOINED`` or ``ACCEPTED`` for a packet that can be processed; for others what becomes of them, counted."""
    settings = s.settings[0]
    status = s.status[0]
    outcome = ACCEPTED
    if status["packets"] > 0 and rx_ticks < status["epoch_ticks"]:
        status["stale"] += 1
        status["stale_in_row"] += 1
        outcome = STALE
    elif anchor < 0:
        outcome = NEW_ANCHOR
    elif _silent_anchor(s, rx_ticks) >= 0:
        outcome = SILENT_ANCHOR
    elif s.anchors[anchor]["packets"] == 0:
        outcome = JOINED
    elif tx_ticks == s.anchors[anchor]["tx_ticks"]:
        outcome = REJECTED
    elif _is_impossible(s, anchor, rx_ticks, tx_ticks):
        s.anchors[anchor]["outliers_in_row"] += 1
        status["rejected_in_row"] += 1
        outcome = REJECTED if s.anchors[anchor]["outliers_in_row"] < settings["in_row"] else RESTARTED_CLOCK
    s.status[0]["impossible"] += int(outcome == REJECTED)
    return outcome


@step
def _keep_packet(s: EstimatorState, anchor: int, sequence: int, rx_ticks: int, tx_ticks: int) -> None:
    """Keep what later packets and relays of this one need."""
    a, packet = s.anchors[anchor], s.packets[anchor, sequence % PACKETS_KEPT]
    a["packets"] += 1
    a["tx_ticks"], a["rx_ticks"], a["walked_m"] = tx_ticks, rx_ticks, s.status[0]["walked_m"]
    packet["sequence"], packet["tx_ticks"], packet["rx_ticks"] = sequence, tx_ticks, rx_ticks


@step
def _process_relays(s: EstimatorState, relays: Integers, first: int, last: int) -> None:
    """Process relayed receptions once each, if the tag has received those very packets."""
    for row in range(first, last):
        listener, sender = s.index_of[relays[row, 0]], s.index_of[relays[row, 1]]
        sequence, rx_ticks = relays[row, 2], relays[row, 3]
        if listener >= 0 and sender >= 0 and listener != sender:
            packet, link = s.packets[sender, sequence % PACKETS_KEPT], s.links[listener, sender]
            young = (s.status[0]["epoch_ticks"] - packet["rx_ticks"]) * TICK_S < s.settings[0]["relay_age_s"]
            if packet["sequence"] == sequence and packet["tx_ticks"] > link["tx_ticks"] and young:
                link["tx_ticks"] = packet["tx_ticks"]
                relay(s, listener, sender, packet["tx_ticks"], packet["rx_ticks"], rx_ticks)


@threaded_kernel
def _track(
    s: EstimatorState,
    begin: int,
    anchors: Integers,
    sequences: Integers,
    rx_ticks: Integers,
    tx_ticks: Integers,
    relays: Integers,
    ends: Integers,
    motions: Matrix,
    covariances: Matrix,
    levels: Matrix,
) -> int:
    """Process packets from ``begin`` on; returns the first that requires an anchor to join or leave, or their number.

    Rows of ``motions``, ``covariances`` and ``levels`` are filled in, where there are any.
    """
    dim = s.settings[0]["dim"]
    for n in range(begin, len(anchors)):
        first = ends[n - 1] if n > 0 else 0
        outcome = _process(
            s, anchors[n], sequences[n], rx_ticks[n], tx_ticks[n], relays, first, ends[n], -1, 0, 0.0, 1.0
        )
        if outcome >= NEW_ANCHOR:
            return n
        if len(motions) > 0:
            for one in range(dim):
                motions[n, one], motions[n, dim + one] = s.x[one], s.x[dim + len(s.anchors) + one]
        if len(covariances) > 0:
            for one in range(dim):
                for other in range(dim):
                    covariances[n, dim * one + other] = s.P[one, other]
        if len(levels) > 0:
            protect(s, levels[n])
            levels[n, LEVELS] = outcome
            levels[n, LEVELS + 1] = integrity_state(s, levels[n])
    return len(anchors)


@kernel
def _process_frame(
    x: Vector,
    P: Matrix,
    V: Matrix,
    information: Matrix,
    evidence: Vector,
    anchors: Records,
    packets: Records,
    links: Records,
    status: Records,
    settings: Records,
    index_of: Integers,
    h: Vector,
    h_index: Indices,
    ph: Vector,
    fault_input: Vector,
    work: Matrix,
    identifiers: Integers,
    packed: NDArray[np.uint8],
    packed_bytes: int,
    listed: Integers,
    listed_rows: int,
    table_index: int,
    sequence: int,
    rx_ticks: int,
    tx_ticks: int,
    master: int,
    subticks: int,
    report_variance_m2: float,
    variance_factor: float,
    levels: Vector,
    rows: Matrix,
) -> int:
    """``_process`` for a packet whose relays are bytes of its frame, and all that a fix carries.

    The state comes in pieces, as the compiler takes arrays from Python in half the time that a tuple of them takes.
    """
    s = EstimatorState(
        x, P, V, information, evidence, anchors, packets, links, status, settings, index_of, h, h_index, ph,
        fault_input, work,
    )  # fmt: skip
    count = listed_rows
    for begin in range(0, packed_bytes, 8):
        identifier = np.int64(packed[begin]) | np.int64(packed[begin + 1]) << 8
        stamp = np.int64(0)
        for byte in range(5):
            stamp |= np.int64(packed[begin + 3 + byte]) << (8 * byte)
        for anchor in range(len(s.anchors)):
            index = s.anchors[anchor]["table_index"]
            if identifiers[index] == identifier:
                listed[count, 0], listed[count, 1], listed[count, 2] = table_index, index, packed[begin + 2]
                least = tx_ticks - HALF_WRAP_TICKS
                listed[count, 3] = least + ((stamp - least) & TICK_MASK)
                count += 1
                break
    outcome = _process(
        s, table_index, sequence, rx_ticks, tx_ticks, listed, 0, count, master, subticks, report_variance_m2,
        variance_factor,
    )  # fmt: skip
    if outcome >= NEW_ANCHOR:
        return outcome
    _fill_rows(s, levels, rows)
    return outcome


@step
def _fill_rows(s: EstimatorState, levels: Vector, rows: Matrix) -> None:
    """Write all that a fix carries."""
    fill_motion(s, rows)
    rows[QUALITY, 0], rows[QUALITY, 1] = s.status[0]["mean_nis"], s.status[0]["mean_square_m2"]
    protect(s, levels)
    rows[QUALITY, 2] = levels[FIRST_TEST:].max()
    rows[PROTECTION, 0], rows[PROTECTION, 1], rows[PROTECTION, 2] = levels[HPL], levels[VPL], integrity_state(s, levels)


@kernel
def _process_difference(
    s: EstimatorState,
    table_a: int,
    table_b: int,
    rx_ticks: int,
    difference_m: float,
    levels: Vector,
    rows: Matrix,
) -> int:
    """Process one ready-made difference of ranges, to b less to a, and all that a fix carries."""
    status, a, b = s.status[0], s.index_of[table_a], s.index_of[table_b]
    if rx_ticks < status["epoch_ticks"]:
        status["stale"] += 1
        status["stale_in_row"] += 1
        return STALE
    if _silent_anchor(s, rx_ticks) >= 0:
        return SILENT_ANCHOR
    status["stale_in_row"] = 0
    elapsed_s = (rx_ticks - status["epoch_ticks"]) * TICK_S
    predict(s, rx_ticks)
    fade_faults(s)
    outcome = ACCEPTED if difference(s, a, b, rx_ticks, difference_m) == 1 else REJECTED
    status["packets"] += 1
    for anchor in (a, b):
        used = s.anchors[anchor]
        used["packets"] += 1
        used["rx_ticks"], used["walked_m"] = rx_ticks, status["walked_m"]
    _check_motion_and_faults(s, elapsed_s)
    _fill_rows(s, levels, rows)
    return outcome


@kernel
def _process_height(
    s: EstimatorState, height_m: float, std_m: float, is_barometer: bool, levels: Vector, rows: Matrix
) -> int:
    """Process a sensor's height of the tag, and all that a fix carries."""
    outcome = ACCEPTED if height(s, height_m, std_m, is_barometer) == 1 else REJECTED
    _fill_rows(s, levels, rows)
    return outcome


@step
def fill_motion(s: EstimatorState, rows: Matrix) -> None:
    """Write position, velocity and their covariances as a fix carries them."""
    dim, velocity = s.settings[0]["dim"], layout(s.settings[0]["dim"], len(s.anchors)).velocity
    scale = covariance_scale(s)
    for one in range(dim):
        rows[POSITION, one], rows[VELOCITY, one] = s.x[one], s.x[velocity + one]
        for other in range(dim):
            rows[POSITION + 1 + one, other] = scale * s.P[one, other]
            rows[VELOCITY + 1 + one, other] = scale * s.P[velocity + one, velocity + other]
    if dim == 2:
        rows[POSITION, 2] = s.settings[0]["height_m"]


MAX_ANCHORS_IN_TABLE: Final = 256  # with more, one that is not in the state is forgotten for each new one


class SavedEstimator(Struct, frozen=True):
    """An ``Estimator`` in plain values: its table of anchors, and the arrays of its state as bytes."""

    table: Annotated[tuple[tuple[int, float, float, float, float | None], ...], Meta(max_length=MAX_ANCHORS_IN_TABLE)]
    """Identifier and position of each anchor, and the standard deviation of its coordinates where that is its own."""
    misfits: tuple[int, ...]
    arrays: dict[str, bytes]


class Estimator:
    """The filter of one tag."""

    def __init__(self, settings: EstimatorSettings, table_m: Matrix | None = None) -> None:
        """``table_m``: positions of anchors with identifiers 0, 1, …, shape (n, 3); ``anchor_index`` adds others."""
        self.settings = settings
        self.dim = settings.dim
        self._table_m: list[Vector] = [] if table_m is None else [np.array(row, np.float64) for row in table_m]
        self._table_std_m: list[float | None] = [None] * len(self._table_m)
        self._identifiers = np.arange(len(self._table_m))
        self.index_of = {index: index for index in range(len(self._table_m))}
        """Index in the table of each anchor identifier, by which frames name it."""
        self._misfits: frozenset[int] = frozenset()
        self._levels = np.zeros(LEVELS)
        self._rows = np.zeros((PROTECTED_ROWS, 3))
        self._packed = np.zeros(MAX_PACKED * HEARD.size, np.uint8)
        self._listed = np.zeros((MAX_PACKED, 4), np.int64)
        self._state = new_state(settings, len(self._table_m))

    def save(self) -> SavedEstimator:
        """All that ``restore`` needs to continue with the same bits."""
        table = tuple(
            (anchor, *self._table_m[index].tolist(), self._table_std_m[index])
            for anchor, index in sorted(self.index_of.items(), key=lambda one: one[1])
        )
        return SavedEstimator(table, tuple(self._misfits), packed_state(self._state))

    def restore(self, saved: SavedEstimator) -> None:
        """Continue from what an estimator with the same settings has saved.

        Raises:
            ValueError: kernels could not run on it.
        """
        for anchor, x_m, y_m, z_m, std_m in saved.table:
            self._add_to_table(anchor, np.array((x_m, y_m, z_m)), std_m)
        if len(self.index_of) != len(saved.table):
            raise ValueError("an anchor is in the estimator's table twice")
        self._misfits = frozenset(saved.misfits)
        self._state = unpacked_state(self.settings, len(self._table_m), saved.arrays)

    @property
    def state(self) -> EstimatorState:
        """All states and counters; others after an anchor has joined or left."""
        return self._state

    @property
    def rows(self) -> Matrix:
        """What a fix carries (``POSITION`` and the following), as of the newest packet."""
        return self._rows

    def anchor_index(self, identifier: int, position_m: Vector, std_m: float | None = None) -> int:
        """Index in the table of an anchor: a new one, or one that may have moved.

        ``position_m``, shape (3,), counts as unchanged as long as it is the same array. ``std_m`` is that of each
        coordinate, None for that of the settings; it counts when the anchor joins.
        """
        index = self.index_of.get(identifier)
        if index is None:
            index = self._add_to_table(identifier, position_m, std_m)
        elif self._table_m[index] is not position_m:
            self._table_m[index], self._table_std_m[index] = position_m, std_m
            anchor = self._state.index_of[index]
            if anchor >= 0:
                self._state.anchors[anchor]["position_m"] = position_m
                fit_plane(self._state)
        return index

    def _add_to_table(self, identifier: int, position_m: Vector, std_m: float | None) -> int:
        """Index of a new anchor; a tag that comes through a large site reuses those of anchors left behind."""
        index = len(self._table_m)
        if index >= MAX_ANCHORS_IN_TABLE:
            index = int(np.argmax(self._state.index_of < 0))
            del self.index_of[int(self._identifiers[index])]
            self.index_of[identifier] = index
            self._table_m[index], self._table_std_m[index] = position_m, std_m
            self._identifiers[index] = identifier
            self._misfits -= {index}
        else:
            self.index_of[identifier] = index
            self._table_m.append(position_m)
            self._table_std_m.append(std_m)
            self._identifiers = np.append(self._identifiers, identifier)
            self._state = with_table(self._state, len(self._table_m))
        return index

    def has_anchor(self, identifier: int) -> bool:
        """Whether an anchor is in the state."""
        index = self.index_of.get(identifier)
        return index is not None and self._state.index_of.item(index) >= 0

    @property
    def anchors(self) -> tuple[int, ...]:
        """Identifiers of the anchors in the state."""
        return tuple(self._identifiers[self._state.anchors["table_index"]].tolist())

    def remove_anchor(self, identifier: int) -> None:
        """Let an anchor leave the state, if it is there."""
        if self.has_anchor(identifier):
            anchor = self._state.index_of.item(self.index_of[identifier])
            self._state = without_anchor(self._state, anchor)
            fit_plane(self._state)

    def expect_late(self, table_index: int, late_m: float, variance_m2: float, may_stay: bool) -> None:
        """Expect that an anchor is late by so much at the start, with this variance; ``may_stay``: perhaps for good."""
        if self._state.index_of[table_index] < 0:
            self._resize(NEW_ANCHOR, table_index, 0)
        state, where = self._state, layout(self.dim, len(self._state.anchors))
        anchor = int(state.index_of[table_index])
        change, constant = where.change + anchor, where.constant + anchor
        staying_m = late_m if may_stay else 0.0
        state.x[change], state.x[constant] = late_m - TUNING.staying_share * staying_m, TUNING.staying_share * staying_m
        state.P[change, change] += variance_m2
        state.P[constant, constant] += (TUNING.staying_std * staying_m) ** 2
        state.status["range_errors"] = ALL_RANGE_ERRORS

    def withhold_levels(self, are_withheld: bool = True) -> None:
        """State no levels: it is not sure yet where the tag is, or the anchors' positions are known to be wrong."""
        self._state.status["withholds_levels"] = are_withheld

    def start(
        self,
        rx_ticks: int,
        position_m: Vector,
        covariance_m2: Matrix,
        speed_variance: float,
        open_range_errors: bool = False,
        fault_std_m: float = TUNING.lasting_std_m,
        misfitting: Iterable[int] = (),
    ) -> None:
        """Start at a position, shapes (dim,) and (dim, dim), without any anchor; the share of late packets is kept.

        ``open_range_errors``: expect ranges to be wrong by half a metre and anchors to be misplaced, since what
        the settings assume of them has been contradicted. ``misfitting``: do so of these anchors of the table alone.
        ``fault_std_m``: of range errors of all anchors that the levels are to cover.
        """
        settings, dim = self.settings, self.dim
        state = new_state(settings, len(self._table_m), open_range_errors=open_range_errors)
        state.status["late_share"] = self._state.status["late_share"]
        state.status["fault_std_m"][0, LASTING] = fault_std_m
        self._misfits = frozenset(misfitting)
        state.x[:dim] = position_m
        state.P[:dim, :dim] = covariance_m2
        state.P[range(dim, 2 * dim), range(dim, 2 * dim)] = speed_variance
        state.status["epoch_ticks"] = state.status["start_ticks"] = state.status["faded_ticks"] = rx_ticks
        self._state = state

    def process(
        self,
        table_index: int,
        sequence: int,
        rx_ticks: int,
        tx_ticks: int,
        relays: Integers | Sequence[Sequence[int]] = (),
        *,
        packed: bytes = b"",
        report: Report = NO_REPORT,
        variance_factor: float = 1.0,
    ) -> int:
        """Process one packet; returns what became of it (``ACCEPTED`` …) and leaves ``rows``.

        ``relays``: rows as in ``Packets``; ``packed``: relays as frames carry them (``codec.packed_relays``), anchors
        by the identifiers that ``anchor_index`` was given; ``variance_factor``: on the variance of the tag's reception.
        """
        listed = len(relays)
        if listed:
            if listed + MAX_PACKED > len(self._listed):
                self._listed = np.zeros((listed + MAX_PACKED, 4), np.int64)
            self._listed[:listed] = relays
        if packed:
            self._packed.data[: len(packed)] = packed
        while True:
            outcome = _process_frame(
                *self._state, self._identifiers, self._packed, len(packed), self._listed, listed,
                table_index, sequence, rx_ticks, tx_ticks, report.master, report.subticks,
                report.variance_m2, variance_factor,
                self._levels, self._rows,
            )  # fmt: skip
            if outcome < NEW_ANCHOR:
                return outcome
            self._resize(outcome, table_index, rx_ticks)

    def process_difference(self, table_a: int, table_b: int, rx_ticks: int, difference_m: float) -> int:
        """Process a ready-made difference of ranges, to anchor b less to anchor a; as ``process``."""
        if not np.isfinite(difference_m):
            return REJECTED
        while True:
            for index in (table_a, table_b):
                if self._state.index_of[index] < 0:
                    self._resize(NEW_ANCHOR, index, rx_ticks)
            outcome = _process_difference(
                self._state, table_a, table_b, rx_ticks, difference_m, self._levels, self._rows
            )
            if outcome < NEW_ANCHOR:
                return outcome
            self._resize(outcome, table_a, rx_ticks)

    def process_height(self, height_m: float, std_m: float, is_barometer: bool = False) -> int:
        """Process the tag's height at the newest packet, as a sensor measures it; ``ACCEPTED`` or ``REJECTED``.

        A barometer's zero, which is unknown and moves slowly, is estimated; in three dimensions only.
        """
        return _process_height(self._state, height_m, std_m, is_barometer, self._levels, self._rows)

    def track(
        self,
        packets: Packets,
        motions: Matrix | None = None,
        covariances: Matrix | None = None,
        levels: Matrix | None = None,
    ) -> None:
        """Process many packets in one loop.

        Rows of ``motions``, shape (n, 2·dim), ``covariances``, shape (n, dim·dim), and ``levels``, shape
        (n, LEVELS + 2), are filled in after each packet; the last two columns of the levels are what became of the
        packet and the state of the levels.
        """
        nothing, done = np.empty((0, 0)), 0
        motions = nothing if motions is None else motions
        covariances = nothing if covariances is None else covariances
        levels = nothing if levels is None else levels
        columns = (packets.anchors, packets.sequences, packets.rx_ticks, packets.tx_ticks, packets.relays, packets.ends)
        while True:
            done = _track(self._state, done, *columns, motions, covariances, levels)
            if done == len(packets.anchors):
                return
            index, rx_ticks = int(packets.anchors[done]), int(packets.rx_ticks[done])
            joins = self._state.index_of[index] < 0
            silent = not joins and _silent_anchor(self._state, rx_ticks) >= 0
            self._resize(NEW_ANCHOR if joins else SILENT_ANCHOR if silent else RESTARTED_CLOCK, index, rx_ticks)

    def _resize(self, outcome: int, table_index: int, rx_ticks: int) -> None:
        """Let an anchor join or leave, as a packet requires."""
        state = self._state
        if outcome == NEW_ANCHOR:
            is_open = table_index in self._misfits
            std_m = self._table_std_m[table_index]
            self._state = with_anchor(state, table_index, self._table_m[table_index], is_open, std_m)
        elif outcome == RESTARTED_CLOCK:
            state.status["clock_restarts"] += 1
            self._state = without_anchor(state, int(state.index_of[table_index]))
        else:
            self._state = without_anchor(state, _silent_anchor(state, rx_ticks))
        fit_plane(self._state)

    @property
    def fault_test(self) -> float:
        """The larger test of faults, χ² with as many degrees of freedom as there are anchors if there are none."""
        return float(self._levels[FIRST_TEST:].max())

    @property
    def fits_settings(self) -> bool:
        """Whether the constants of the ranges are as small as the settings state, as far as they are known."""
        s, count = self._state, len(self._state.anchors)
        constants = slice((first := layout(self.dim, count).constant), first + count)
        variances = s.P[constants, constants] + self.settings.range_std_m**2 * np.eye(count)
        return bool(s.x[constants] @ np.linalg.solve(variances, s.x[constants]) < TUNING.fitting_chi2 * count)

    @property
    def multipath_m(self) -> tuple[float, float] | None:
        """How far range errors change, and over which distance walked, where that is more than the settings state."""
        status = self._state.status[0]
        variance_m2, distance_m = float(status["place_variance_m2"]), float(status["place_distance_m"])
        return (variance_m2**0.5, distance_m) if variance_m2 > 0.0 else None

    @property
    def is_late_often(self) -> bool:
        """Whether single packets are late often."""
        return bool(self._state.status[0]["late_share"] > TUNING.late_often_share)

    @property
    def is_lost(self) -> bool:
        """Whether more packets are rejected than a right state would reject."""
        status = self._state.status[0]
        in_row = int(status["rejected_in_row"]) + int(status["stale_in_row"])
        late = min(float(status["late_share"]), 0.45)
        return bool(status["rejected_share"] > TUNING.lost_share or in_row * (1.0 - 2.0 * late) >= TUNING.lost_in_row)

    @property
    def rejects_most(self) -> bool:
        """Whether most measurements lie beyond the gate."""
        return bool(self._state.status[0]["rejected_share"] > TUNING.lost_share)

    @property
    def is_contradicted(self) -> bool:
        """Whether most of what anchors received of each other does not fit: a wrong position shifts all clocks."""
        status = self._state.status[0]
        return bool(
            status["relays_lately_rejected"] > max(TUNING.max_relays_rejected, status["relays_lately_accepted"])
        )

    @property
    def relays_fit(self) -> bool:
        """Whether most of what anchors received of each other fits, and that is more than a few receptions."""
        accepted, rejected = (self._state.status[0][f"relays_lately_{name}"] for name in ("accepted", "rejected"))
        return bool(accepted > max(TUNING.max_relays_rejected, 4.0 * rejected))

    @property
    def obstructed(self) -> tuple[int, ...]:
        """Identifiers of the anchors whose range error has jumped and stayed, or has a lasting fault."""
        anchors = self._state.anchors
        faulty = (anchors["is_obstructed"] != 0) | (anchors["has_fault"] != 0)
        return tuple(self._identifiers[anchors["table_index"][faulty]].tolist()) if faulty.any() else ()

    def horizontal_variance_m2(self, ahead_s: float) -> float:
        """Sum of the variances of x and y ``ahead_s`` later, if nothing is received until then."""
        dim, (_, covariance) = self.dim, self.motion()
        total = 2.0 * self.settings.qa * float(self._state.status[0]["q_scale"]) * ahead_s**3 / 3.0
        for axis in range(2):
            speed = dim + axis
            total += covariance[axis, axis] + ahead_s * (
                2.0 * covariance[axis, speed] + ahead_s * covariance[speed, speed]
            )
        return float(total)

    def motion(self) -> tuple[Vector, Matrix]:
        """Position and velocity at the newest packet, shape (2·dim,), and their covariance."""
        dim, velocity = self.dim, layout(self.dim, len(self._state.anchors)).velocity
        states = [*range(dim), *range(velocity, velocity + dim)]
        return self._state.x[states], self._state.P[np.ix_(states, states)]

    def clock(self, table_index: int) -> tuple[int, float, float] | None:
        """The tag's clock less that of an anchor in the state: whole ticks, the rest in metres, rate in m/s."""
        anchor = int(self._state.index_of[table_index])
        if anchor < 0 or self._state.anchors[anchor]["rx_ticks"] == NEVER:
            return None
        where, x = layout(self.dim, len(self._state.anchors)), self._state.x
        rate = float(x[where.rate + anchor])
        return int(self._state.anchors[anchor]["offset_ticks"]), float(x[where.offset + anchor]), rate
