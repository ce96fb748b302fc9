"""Processing a packet, a ready-made difference or a height; and a batch of packets in one loop."""

from typing import Annotated, Final

from skyless.core.air.frame import HEARD_BYTES, PHASE_STEPS, SHORT_BITS, two_bytes, unsigned
from skyless.core.estimator.faults import fade_faults, open_faults
from skyless.core.estimator.hypotheses import scatter, settle_hypotheses
from skyless.core.estimator.kalman import (
    add_clock_noise,
    finish_updates,
    follows_cycles,
    has_order,
    is_stationary,
    predict,
)
from skyless.core.estimator.levels import fit_plane, integrity_state, largest_test, protect
from skyless.core.estimator.measurements import (
    CLOCK_JUMPED,
    SHORTEST_S,
    USED,
    difference,
    first_reception,
    height,
    own_reception,
    relay,
    report,
    zero_velocity,
)
from skyless.core.estimator.monitor import motion_covariance, update_stationary
from skyless.core.estimator.motion import fill_orientation, look_at_sensor, move
from skyless.core.estimator.phases import close_phases, own_phase, relay_phase
from skyless.core.estimator.state import AXES, LEVELS, State, add_anchor, at, find_anchor, remove_anchor
from skyless.core.fix import ORIENTATION, POSITION, PROTECTION, QUALITY, VELOCITY
from skyless.core.integrity import HPL, STATE, VPL
from skyless.core.native.records import (
    MAX_ANCHORS,
    MAX_RELAYS,
    MOTION_STATES,
    PACKETS_KEPT,
    PHASE_STATES,
    Array,
    Bytes,
    Matrix,
    Reals,
    Record,
    Ticks,
    record,
)
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S, nearest

REJECTED, ACCEPTED, JOINED, STALE, RESTARTED_CLOCK = range(5)
"""Outcomes of a packet. After the last one its anchor joins again and the packet is processed again."""

MAX_RATE_MPS: Final = 100e-6 * SPEED_OF_LIGHT_MPS  # between two clocks that are still crystals


@record
class Place(Record):
    """An anchor and its position."""

    anchor: int
    """Identifier."""
    position_m: Annotated[Reals, AXES]
    std_m: float
    """Standard deviation of each coordinate; if negative, that of the settings."""
    is_open: bool
    """Whether it joins with range errors beyond those of the settings."""


@record
class Relay(Record):
    """One anchor's reception of another's packet. The listener is usually the sender of the packet with the relay."""

    listener: int
    """Identifier of the receiving anchor."""
    anchor: int
    """Identifier of the received anchor."""
    sequence: int
    rx_ticks: Ticks
    """The listener's stamp: unwrapped, or only the lowest bits if it is short (``relay_rx_ticks``)."""
    is_short: bool
    has_phase: bool
    phase_cycles: float
    """Carrier phase as the listener received it, in [0, 1)."""


@record
class ScaledTime(Record):
    """A TX time on a scale common to packets of several anchors."""

    ticks: Ticks
    fraction_ticks: float
    variance_m2: float


@record
class Packet(Record):
    """A packet received by the tag, with unwrapped stamps."""

    place: Place
    sequence: int
    rx_ticks: Ticks
    """RX time on the tag's clock."""
    tx_ticks: Ticks
    """TX time on the anchor's own clock."""
    variance_factor: float
    """Factor on the variance of the tag's reception."""
    has_phase: bool
    phase_cycles: float
    """Carrier phase as the tag received it, in [0, 1)."""
    master: int
    """Identifier of the anchor against whose clock this one reports its own; −1 without a report."""
    subticks: Ticks
    """The anchor's reading minus the master's at the packet's TX stamp, modulo 2⁴⁸."""
    report_variance_m2: float
    relays_have_phases: bool
    """Whether its frame carries phases in its relays, and therefore short stamps."""


@record
class Relays(Record):
    """The relays of a packet."""

    count: int
    rows: Annotated[Array[Relay], MAX_RELAYS]


def leave(s: State, identifier: int) -> None:
    """Remove an anchor from the state, if it is there."""
    anchor = find_anchor(s, identifier)
    if anchor >= 0:
        remove_anchor(s, anchor)
        fit_plane(s)


# One packet


def process(s: State, packet: Packet, relays: Relays) -> int:
    """Process a packet and its relays. Returns the outcome and fills ``levels`` and ``fix``."""
    outcome = _process_packet(s, packet, relays)
    fill_fix(s)
    return outcome


def process_frame(s: State, packet: Packet, relays: Relays, packed: Bytes, packed_bytes: int) -> int:
    """``process`` with further relays, encoded as in a frame."""
    take_relays(packet, relays, packed, packed_bytes)
    return process(s, packet, relays)


def take_relays(packet: Packet, relays: Relays, packed: Bytes, packed_bytes: int) -> None:
    """Append encoded relays to those of a packet, as far as there is space."""
    for begin in range(0, packed_bytes, HEARD_BYTES):
        if relays.count < MAX_RELAYS:
            relayed = relays.rows[relays.count]
            relayed.listener = packet.place.anchor
            relayed.anchor = two_bytes(packed, begin)
            relayed.sequence = packed[begin + 2]
            relayed.is_short, relayed.has_phase = packet.relays_have_phases, False
            if relayed.is_short:
                code = packed[begin + HEARD_BYTES - 1]
                relayed.rx_ticks = unsigned(packed, begin + 3, SHORT_BITS // 8)
                relayed.has_phase, relayed.phase_cycles = code >= PHASE_STEPS, (code % PHASE_STEPS) / PHASE_STEPS
            else:
                relayed.rx_ticks = nearest(unsigned(packed, begin + 3, HEARD_BYTES - 3), packet.tx_ticks)
            relays.count += 1


def relay_rx_ticks(relayed: Relay, tx_ticks: Ticks, elapsed: Ticks) -> Ticks:
    """The unwrapped stamp of a relay.

    ``tx_ticks`` is the listener's stamp of a packet that the tag received ``elapsed`` after the relayed one.
    """
    return nearest(relayed.rx_ticks, tx_ticks - elapsed, SHORT_BITS) if relayed.is_short else relayed.rx_ticks


def _process_packet(s: State, packet: Packet, relays: Relays) -> int:
    """Process a packet. Its anchor joins if it is not in the state."""
    status, place = s.status, packet.place
    if status.packets > 0 and packet.rx_ticks < status.epoch_ticks:
        status.stale += 1
        status.stale_in_row += 1
        return STALE
    _remove_silent(s, packet.rx_ticks)
    anchor = _present(s, place)
    if anchor < 0:
        return REJECTED
    outcome = _process_of(s, anchor, packet, relays)
    if outcome == RESTARTED_CLOCK:
        status.clock_restarts += 1
        remove_anchor(s, anchor)
        anchor = _present(s, place)
        outcome = _process_of(s, anchor, packet, relays)
    return outcome


def _present(s: State, place: Place) -> int:
    """The index of an anchor, which is added or moved if needed; −1 if there is no room."""
    anchor, is_new = find_anchor(s, place.anchor), False
    if anchor < 0 and s.count < MAX_ANCHORS:
        anchor, is_new = add_anchor(s, place.anchor, place.position_m, place.std_m, place.is_open), True
    if anchor >= 0:
        for axis in range(AXES):
            is_new = is_new or s.anchors[anchor].position_m[axis] != place.position_m[axis]
            s.anchors[anchor].position_m[axis] = place.position_m[axis]
    if is_new:
        fit_plane(s)
    return anchor


def _remove_silent(s: State, rx_ticks: Ticks) -> None:
    """Remove anchors that have been silent for too long."""
    for anchor in range(s.count - 1, -1, -1):
        a = s.anchors[anchor]
        if a.packets > 0 and (rx_ticks - a.rx_ticks) * TICK_S > s.settings.drop_s:
            remove_anchor(s, anchor)
            fit_plane(s)


def _process_of(s: State, anchor: int, packet: Packet, relays: Relays) -> int:
    """Process a packet of an anchor in the state."""
    status, a, rx_ticks, tx_ticks = s.status, s.anchors[anchor], packet.rx_ticks, packet.tx_ticks
    elapsed_s = (rx_ticks - status.epoch_ticks) * TICK_S
    outcome = _admit(s, anchor, rx_ticks, tx_ticks)
    if outcome in (REJECTED, RESTARTED_CLOCK):
        return outcome
    status.stale_in_row = 0
    _advance_to(s, rx_ticks)
    if has_order(s):
        _process_relays(s, packet, relays)
        add_clock_noise(s, anchor, rx_ticks)
    if outcome == JOINED:
        first_reception(s, anchor, rx_ticks, tx_ticks, packet.variance_factor)
    else:
        result = own_reception(s, anchor, rx_ticks, tx_ticks, packet.variance_factor)
        if result == CLOCK_JUMPED:
            return RESTARTED_CLOCK
        outcome = ACCEPTED if result == USED else REJECTED
        if PHASE_STATES > 0 and packet.has_phase and s.settings.carrier_cycles > 0:
            _process_phase(s, anchor, packet.phase_cycles, result == USED)
    is_known = a.packets > 0
    status.packets += 1
    _keep_packet(s, anchor, packet)
    if is_known:
        status.relays_lately_accepted *= 1.0 - s.tuning.mean_gain
        status.relays_lately_rejected *= 1.0 - s.tuning.mean_gain
        if not has_order(s):
            _process_relays(s, packet, relays)
        if packet.report_variance_m2 > 0.0 and packet.master >= 0:
            master = find_anchor(s, packet.master)
            if master >= 0 and master != anchor:
                report(s, anchor, master, packet.subticks, packet.report_variance_m2)
    finish_updates(s)
    if PHASE_STATES > 0:
        settle_hypotheses(s)
    _check_motion_and_faults(s, elapsed_s)
    return outcome


def _advance_to(s: State, rx_ticks: Ticks) -> None:
    """Time update to a tag time."""
    if MOTION_STATES > 0:
        look_at_sensor(s, rx_ticks)
    predict(s, rx_ticks)
    if MOTION_STATES > 0:
        move(s, rx_ticks)
    fade_faults(s)


def _admit(s: State, anchor: int, rx_ticks: Ticks, tx_ticks: Ticks) -> int:
    """Return ``JOINED`` or ``ACCEPTED`` for a packet that can be processed; otherwise count and return its outcome."""
    a, status = s.anchors[anchor], s.status
    if a.packets == 0:
        return JOINED
    if tx_ticks == a.tx_ticks or (rx_ticks - a.rx_ticks) * TICK_S < SHORTEST_S:
        status.impossible += 1
        return REJECTED
    if _is_impossible(s, anchor, rx_ticks, tx_ticks):
        a.outliers_in_row += 1
        status.rejected_in_row += 1
        if a.outliers_in_row >= s.tuning.in_row:
            return RESTARTED_CLOCK
        status.impossible += 1
        return REJECTED
    return ACCEPTED


def _is_impossible(s: State, anchor: int, rx_ticks: Ticks, tx_ticks: Ticks) -> bool:
    """Whether no clock can have got from the anchor's newest packet to this one."""
    a = s.anchors[anchor]
    elapsed = rx_ticks - a.rx_ticks
    change_m = abs(elapsed - (tx_ticks - a.tx_ticks)) * TICK_M
    return change_m > s.tuning.restart_m + MAX_RATE_MPS * elapsed * TICK_S


def _keep_packet(s: State, anchor: int, packet: Packet) -> None:
    """Keep what later packets of the anchor, and relays of this one, need."""
    a, kept = s.anchors[anchor], s.packets[anchor][packet.sequence % PACKETS_KEPT]
    a.packets += 1
    a.tx_ticks = packet.tx_ticks
    a.rx_ticks = packet.rx_ticks
    a.walked_m = s.status.walked_m
    kept.sequence = packet.sequence
    kept.tx_ticks = packet.tx_ticks
    kept.rx_ticks = packet.rx_ticks


def _process_phase(s: State, anchor: int, phase_cycles: float, is_used: bool) -> None:
    """Process the phase of a reception, if the stamp was used."""
    if is_used:
        own_phase(s, anchor, phase_cycles)
    elif s.anchors[anchor].outliers_in_row > 1:
        close_phases(s)


def _process_relays(s: State, packet: Packet, relays: Relays) -> None:
    """Process the relays of a packet: as listed, the newest first, or in order."""
    for one in range(relays.count):
        _process_relay(s, packet, relays.rows[relays.count - 1 - one if has_order(s) else one])
    finish_updates(s)


def _process_relay(s: State, packet: Packet, relayed: Relay) -> None:
    """Process a relay once, if the tag has received that packet."""
    listener, sender = find_anchor(s, relayed.listener), find_anchor(s, relayed.anchor)
    if listener < 0 or sender < 0 or sender == listener or not s.anchors[listener].has_rate:
        return
    kept, link = s.packets[sender][relayed.sequence % PACKETS_KEPT], s.links[listener][sender]
    is_young = (s.status.epoch_ticks - kept.rx_ticks) * TICK_S < s.settings.relay_age_s
    if kept.sequence == relayed.sequence and kept.tx_ticks > link.tx_ticks and is_young:
        link.tx_ticks = kept.tx_ticks
        rx_ticks = relay_rx_ticks(relayed, packet.tx_ticks, packet.rx_ticks - kept.rx_ticks)
        if has_order(s):
            add_clock_noise(s, sender, kept.rx_ticks)
            add_clock_noise(s, listener, kept.rx_ticks)
        is_used = relay(s, listener, sender, kept.tx_ticks, kept.rx_ticks, rx_ticks)
        if PHASE_STATES > 0 and is_used and relayed.has_phase and s.status.has_phases:
            relay_phase(s, listener, sender, kept.rx_ticks, relayed.phase_cycles)


def _check_motion_and_faults(s: State, elapsed_s: float) -> None:
    """Check whether the tag is stationary and, once a round of packets, whether there are faults.

    An anchor whose clock is wrong leaves the state, to join again with its next packet.
    """
    if s.settings.stationary_s > 0.0:
        update_stationary(s, elapsed_s)
        if is_stationary(s):
            zero_velocity(s)
    count = s.count
    if s.status.packets % count == 0:
        open_faults(s)
        if s.count < count:
            fit_plane(s)


# What a fix carries


def fill_fix(s: State) -> None:
    """Fill the rows of a fix."""
    velocity = s.layout.velocity
    for one in range(s.dim):
        s.fix[POSITION][one] = s.x[one]
        s.fix[VELOCITY][one] = s.x[velocity + one]
        for other in range(s.dim):
            s.fix[POSITION + 1 + one][other] = motion_covariance(s, one, other)
            s.fix[VELOCITY + 1 + one][other] = motion_covariance(s, velocity + one, velocity + other)
    if s.dim == 2:
        s.fix[POSITION][2] = s.settings.height_m
    if MOTION_STATES > 0:
        fill_orientation(s)
    if PHASE_STATES > 0:
        s.fix[ORIENTATION + 1][2] = s.hypotheses.count if follows_cycles(s) else 0
    protect(s)
    s.fix[QUALITY][0] = s.status.mean_nis
    s.fix[QUALITY][1] = s.status.mean_square_m2
    s.fix[QUALITY][2] = largest_test(s)
    s.fix[PROTECTION][HPL] = s.levels[HPL]
    s.fix[PROTECTION][VPL] = s.levels[VPL]
    s.fix[PROTECTION][STATE] = integrity_state(s)


# Ready-made differences and heights


def process_difference(s: State, a: Place, b: Place, rx_ticks: Ticks, difference_m: float) -> int:
    """Process a ready-made difference of ranges, to anchor b minus to anchor a, and fill the rows of a fix."""
    status = s.status
    if rx_ticks < status.epoch_ticks:
        status.stale += 1
        status.stale_in_row += 1
        return STALE
    _remove_silent(s, rx_ticks)
    if _present(s, a) < 0 or _present(s, b) < 0:
        return REJECTED
    near, far = find_anchor(s, a.anchor), find_anchor(s, b.anchor)
    status.stale_in_row = 0
    elapsed_s = (rx_ticks - status.epoch_ticks) * TICK_S
    _advance_to(s, rx_ticks)
    outcome = ACCEPTED if difference(s, near, far, rx_ticks, difference_m) == USED else REJECTED
    status.packets += 1
    _note_difference(s, near, rx_ticks)
    _note_difference(s, far, rx_ticks)
    _check_motion_and_faults(s, elapsed_s)
    fill_fix(s)
    return outcome


def _note_difference(s: State, anchor: int, rx_ticks: Ticks) -> None:
    """Record the use of an anchor in a difference."""
    a = s.anchors[anchor]
    a.packets += 1
    a.rx_ticks = rx_ticks
    a.walked_m = s.status.walked_m


def process_height(s: State, height_m: float, std_m: float, is_barometer: bool) -> int:
    """Process a height sensor's reading, and fill the rows of a fix."""
    outcome = ACCEPTED if height(s, height_m, std_m, is_barometer) == USED else REJECTED
    fill_fix(s)
    return outcome


# Many packets in one loop


@record
class BatchPacket(Record):
    """A packet of a batch."""

    place: int
    """Index of its anchor in the table of places."""
    sequence: int
    rx_ticks: Ticks
    tx_ticks: Ticks
    variance_factor: float = 1.0
    has_phase: bool
    phase_cycles: float
    end: int
    """End of its relays in their table; they begin at the end of the previous packet's."""


@record
class BatchRow(Record):
    """The state after a packet of a batch."""

    position_m: Annotated[Reals, AXES]
    velocity_mps: Annotated[Reals, AXES]
    covariance_m2: Annotated[Matrix, AXES, AXES]
    levels: Annotated[Reals, LEVELS]
    """As written by ``protect``, if requested."""
    integrity: int
    outcome: int


def track(
    s: State,
    places: Array[Place],
    packets: Array[BatchPacket],
    relays: Array[Relay],
    rows: Array[BatchRow],
    count: int,
    has_levels: bool,
) -> None:
    """Process a batch of packets, and write a row for each."""
    packet, taken = Packet(), Relays()
    packet.master = -1
    begin = 0
    for one in range(count):
        given = packets[one]
        packet.place = places[given.place]
        packet.sequence = given.sequence
        packet.rx_ticks = given.rx_ticks
        packet.tx_ticks = given.tx_ticks
        packet.variance_factor = given.variance_factor
        packet.has_phase, packet.phase_cycles = given.has_phase, given.phase_cycles
        taken.count = min(given.end - begin, MAX_RELAYS)
        for place in range(taken.count):
            taken.rows[place] = relays[begin + place]
        begin = given.end
        rows[one].outcome = _process_packet(s, packet, taken)
        _fill_row(s, rows[one], has_levels)


def _fill_row(s: State, row: BatchRow, has_levels: bool) -> None:
    """Write a row of a batch."""
    for one in range(s.dim):
        row.position_m[one] = s.x[one]
        row.velocity_mps[one] = s.x[s.layout.velocity + one]
        for other in range(s.dim):
            row.covariance_m2[one][other] = s.P[at(one, other)] + scatter(s, one, other)
    if has_levels:
        protect(s)
        for level in range(LEVELS):
            row.levels[level] = s.levels[level]
        row.integrity = integrity_state(s)
