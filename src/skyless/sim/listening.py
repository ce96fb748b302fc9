"""Which nodes receive a frame, with which stamp, and why others do not: one compiled step over all nodes.

A sending node receives nothing (half duplex). Frames that overlap at a listener destroy each other unless one is
stronger than every other by the capture margin. Not modelled: real receivers that locked on the weaker one first lose
both.
"""

from collections.abc import Sequence
from enum import StrEnum
from math import atan2, cos, inf, log, sin, sqrt
from typing import Annotated, Final

from msgspec import Struct

from skyless.core.native.arithmetic import floor, hypot
from skyless.core.native.records import Array, Count, Reals, Record, Ticks, record
from skyless.core.native.views import view
from skyless.core.site import AnchorSite
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_MASK, TICK_S
from skyless.sim.impairments import AnchorDisplacement, DelayError, Impairments, Outage, slope_error_m
from skyless.sim.oscillator import Clock, advance, clock_rate
from skyless.sim.streams import Noise, draw_normal, draw_uniform
from skyless.sim.trajectory import Piece, Trajectory
from skyless.site.channel import (
    Barrier,
    ChannelModel,
    cross_walls,
    delivery_probability,
    first_path_loss_db,
    power_bias_m,
    received_power_dbm,
)

# Positions, motion and radio noise of a world's nodes, as records for the kernels.


class TagSpec(Struct, frozen=True):
    """A tag of a world, without its computations."""

    trajectory: Trajectory
    outages: tuple[Outage, ...] = ()


@record
class Station(Record):
    """A node's antenna and radio."""

    is_on: bool
    is_tag: bool
    origin_s: float
    """Time at which position and velocity apply; the acceleration is constant around it."""
    position_m: Annotated[Reals, 3]
    velocity_mps: Annotated[Reals, 3]
    acceleration_mps2: Annotated[Reals, 3]
    tx_noise_ticks: float
    rx_noise_ticks: float
    tx_error_ticks: float
    """True minus configured antenna delay."""
    rx_error_ticks: float
    body_m: float
    """Delay through the person who carries the tag, 0 for none."""
    body_direction_rad: float
    body_cosine: float
    """Cosine of half the sector's width."""


def make_stations(anchors: Sequence[AnchorSite], tags: Sequence[TagSpec], impairments: Impairments) -> Array[Station]:
    """Stations of a world, anchors first, then tags, all off; the tags' positions are not set yet."""
    stations: Array[Station] = (Station * (len(anchors) + len(tags)))()
    body = impairments.body
    for node, station in enumerate(stations):
        station.tx_noise_ticks = impairments.tx_stamp_ps * 1e-12 / TICK_S
        station.rx_noise_ticks = impairments.rx_stamp_ps * 1e-12 / TICK_S
        station.is_tag = node >= len(anchors)
        if body is not None and station.is_tag:
            station.body_m, station.body_direction_rad = body.delay_m, body.direction_rad
            station.body_cosine = cos(0.5 * body.sector_rad)
    errors = {error.anchor: error for error in impairments.delay_errors if error.from_s <= 0.0}
    shifts = {shift.anchor: shift for shift in impairments.anchor_displacements if shift.from_s <= 0.0}
    for node, anchor in enumerate(anchors):
        displace(stations[node], anchor, shifts.get(anchor.id, AnchorDisplacement(anchor.id)))
        if anchor.id in errors:
            set_delays(stations[node], errors[anchor.id])
    return stations


def displace(station: Station, anchor: AnchorSite, shift: AnchorDisplacement) -> None:
    """Move an anchor to its displaced position."""
    position_m = anchor.x_m + shift.x_m, anchor.y_m + shift.y_m, anchor.z_m + shift.z_m
    view(station.position_m)[:] = position_m


def set_delays(station: Station, error: DelayError) -> None:
    """Set the errors of an anchor's antenna delays."""
    station.tx_error_ticks, station.rx_error_ticks = error.tx_ticks, error.rx_ticks


def set_piece(station: Station, piece: Piece) -> None:
    """Let a node move along a piece of its trajectory."""
    station.origin_s = piece.origin_s
    view(station.position_m)[:] = piece.position_m
    view(station.velocity_mps)[:] = piece.velocity_mps
    view(station.acceleration_mps2)[:] = piece.acceleration_mps2


def coordinate_m(s: Station, axis: int, t_s: float) -> float:
    """One coordinate of a node at a true time."""
    dt_s = t_s - s.origin_s
    turned = s.velocity_mps[axis] + 0.5 * dt_s * s.acceleration_mps2[axis]
    return s.position_m[axis] + dt_s * turned


def velocity_mps(s: Station, axis: int, t_s: float) -> float:
    """One component of a node's velocity at a true time."""
    return s.velocity_mps[axis] + (t_s - s.origin_s) * s.acceleration_mps2[axis]


def body_delay_m(sender: Station, listener: Station, t_s: float) -> float:
    """Delay of a sender's messages through the body that carries a listener, 0 if it is not in between."""
    if listener.body_m == 0.0:
        return 0.0
    east_m = coordinate_m(sender, 0, t_s) - coordinate_m(listener, 0, t_s)
    north_m = coordinate_m(sender, 1, t_s) - coordinate_m(listener, 1, t_s)
    heading = atan2(velocity_mps(listener, 1, t_s), velocity_mps(listener, 0, t_s))
    towards = heading + listener.body_direction_rad
    along_m = east_m * cos(towards) + north_m * sin(towards)
    return listener.body_m if along_m >= listener.body_cosine * hypot(east_m, north_m) else 0.0


class Outcome(StrEnum):
    """Outcome of a frame at a listener; the values appear in reports."""

    HEARD = "heard"
    WEAK = "below-sensitivity"
    HALF_DUPLEX = "half-duplex"
    COLLISION = "collision"
    LOST = "message-loss"


OUTCOMES: Final = tuple(Outcome)
_HEARD: Final = OUTCOMES.index(Outcome.HEARD)
_WEAK: Final = OUTCOMES.index(Outcome.WEAK)
_HALF_DUPLEX: Final = OUTCOMES.index(Outcome.HALF_DUPLEX)
_COLLISION: Final = OUTCOMES.index(Outcome.COLLISION)
_LOST: Final = OUTCOMES.index(Outcome.LOST)
_OUTCOMES: Final = len(OUTCOMES)
_INFINITE: Final = inf


@record
class Row(Record):
    """One frame at one node that received it."""

    node: int
    rx_ticks: Ticks
    """The listener's 40-bit counter."""
    position_m: Annotated[Reals, 3]
    """The true one at the frame's emission."""
    rx_power_dbm: float
    first_path_power_dbm: float
    carrier_offset_ppm: float
    reading_ticks: float
    """The listener's counter modulo 128 when the carrier arrived, without noise."""
    extra_m: float
    """By how much the way was longer than the distance."""
    phase_cycles: float
    """Of the carrier (``Carriers``), where that is simulated."""


@record
class Other(Record):
    """A frame that may overlap the one that is received; times from that frame's RMARKER."""

    sender: int
    begin_s: float
    end_s: float


@record
class OneFrame(Record):
    """A frame that is received at all nodes of a world, and what became of it."""

    sender: int
    anchors: int
    """Number of anchors; nodes that follow are tags."""
    nodes: int
    others: int
    """Number of frames that may overlap it."""
    barriers: int
    is_diagnosed: bool
    """Whether rows have powers and carrier offsets."""
    ticks: Ticks
    """True time of the emission, whole ticks."""
    fraction: float
    begin_s: float
    """Begin and end relative to the RMARKER."""
    end_s: float
    bias_m: float
    """The sender's present bias at tags."""
    slope_m: float
    """That of ``RangeErrorModel``."""
    heard_by_anchors: int
    heard: int
    most_used: int
    """Numbers used of that node's noise which used most."""


@record
class Link(Record):
    """The way between two nodes at a true time."""

    distance_m: float
    delay_m: float
    """By walls."""
    power_dbm: float
    range_rate_mps: float


def find_link(
    f: OneFrame,
    stations: Array[Station],
    channel: ChannelModel,
    barriers: Array[Barrier],
    sender: int,
    listener: int,
    t_s: float,
    way: Link,
) -> None:
    """Find the way between two nodes at a true time."""
    one, other = stations[sender], stations[listener]
    squared_m2, product = 0.0, 0.0
    for axis in range(3):
        step_m = coordinate_m(other, axis, t_s) - coordinate_m(one, axis, t_s)
        squared_m2 += step_m * step_m
        product += step_m * (velocity_mps(other, axis, t_s) - velocity_mps(one, axis, t_s))
    way.distance_m = sqrt(squared_m2)
    loss_db, delay_m = 0.0, 0.0
    if f.barriers > 0:
        loss_db, delay_m = cross_walls(
            barriers,
            f.barriers,
            coordinate_m(one, 0, t_s),
            coordinate_m(one, 1, t_s),
            coordinate_m(one, 2, t_s),
            coordinate_m(other, 0, t_s),
            coordinate_m(other, 1, t_s),
            coordinate_m(other, 2, t_s),
        )
        if not other.is_tag and not channel.walls_between_anchors:
            delay_m = 0.0
    way.delay_m = delay_m
    way.power_dbm = received_power_dbm(channel.tx_power_dbm, way.distance_m, loss_db)
    way.range_rate_mps = product / max(way.distance_m, 1e-9)


def overlap_outcome(
    f: OneFrame,
    stations: Array[Station],
    channel: ChannelModel,
    barriers: Array[Barrier],
    others: Array[Other],
    listener: int,
    t_s: float,
    way: Link,
) -> int:
    """Outcome at a listener of overlapping frames: heard, half duplex or collision."""
    flight_s = (way.distance_m + way.delay_m) / SPEED_OF_LIGHT_MPS
    begin_s, end_s = f.begin_s + flight_s, f.end_s + flight_s
    its = Link()
    outcome = _HEARD
    for index in range(f.others):
        other = others[index]
        if other.sender == listener:
            if other.begin_s < end_s and other.end_s > begin_s:
                return _HALF_DUPLEX
            continue
        find_link(f, stations, channel, barriers, other.sender, listener, t_s, its)
        flight_s = (its.distance_m + its.delay_m) / SPEED_OF_LIGHT_MPS
        overlaps = other.begin_s + flight_s < end_s and other.end_s + flight_s > begin_s
        if overlaps and way.power_dbm - its.power_dbm < channel.capture_db:
            outcome = _COLLISION
    return outcome


def reception_outcome(channel: ChannelModel, noise: Noise, power_dbm: float) -> int:
    """Outcome at a listener by power and chance: heard, weak or lost. Draws only if chance decides."""
    margin = (power_dbm - channel.sensitivity_dbm) / channel.sensitivity_width_db
    if margin < -30.0:
        return _WEAK
    if margin < 30.0:
        probability = delivery_probability(power_dbm, channel.sensitivity_dbm, channel.sensitivity_width_db)
        drawn = draw_uniform(noise)
        if drawn > probability:
            return _WEAK
    if channel.loss_probability > 0.0:
        drawn = draw_uniform(noise)
        if drawn < channel.loss_probability:
            return _LOST
    return _HEARD


def extra_path_m(is_tag: bool, channel: ChannelModel, noise: Noise, bias_m: float) -> float:
    """Extra path of a message: the sender's present bias (tags only) and, by chance, an exponential delay."""
    extra_m = bias_m if is_tag else 0.0
    if (is_tag or channel.nlos_between_anchors) and channel.nlos_probability > 0.0:
        drawn = draw_uniform(noise)
        if drawn < channel.nlos_probability:
            drawn = draw_uniform(noise)
            extra_m -= channel.nlos_mean_m * log(drawn)
    return extra_m


def stamp(
    clock: Clock, noise: Noise, rx_noise_ticks: float, emission_ticks: Ticks, arrival_ticks: float, error_ticks: float
) -> Ticks:
    """RX stamp of a node, rounded to ticks; ``arrival_ticks`` counts from ``emission_ticks``."""
    carry = floor(arrival_ticks)
    advance(clock, noise, emission_ticks + carry, arrival_ticks - carry)
    noise_ticks = rx_noise_ticks * draw_normal(noise)
    fraction = clock.local_fraction + error_ticks + noise_ticks
    return (clock.local_ticks + floor(fraction + 0.5)) & TICK_MASK


def measure(sender: Clock, own: Clock, channel: ChannelModel, noise: Noise, way: Link, row: Row) -> None:
    """Fill in the diagnostics of a reception."""
    row.rx_power_dbm = way.power_dbm + channel.power_noise_db * draw_normal(noise)
    row.first_path_power_dbm = row.rx_power_dbm - first_path_loss_db(row.extra_m)
    offset = clock_rate(sender) - clock_rate(own) - way.range_rate_mps / SPEED_OF_LIGHT_MPS
    noise_ppm = channel.carrier_noise_ppm * draw_normal(noise)
    row.carrier_offset_ppm = 1e6 * offset + noise_ppm


def receive_frame(
    f: OneFrame,
    clocks: Array[Clock],
    noises: Array[Noise],
    stations: Array[Station],
    channel: ChannelModel,
    power_biases_m: Reals,
    barriers: Array[Barrier],
    others: Array[Other],
    range_errors_m: Reals,
    heard: Array[Row],
    tally: Array[Count],
) -> None:
    """Deliver one frame to every node that is on, or lose it.

    ``power_biases_m``: those of stamps, as ``power_bias_m`` takes them. ``range_errors_m``: node by node those of all
    anchors, infinite if the sender does not reach the listener. Fills ``heard``, one row for each node that received
    the frame, and counts into ``tally``, for anchors and then for tags each outcome.
    """
    t_s = (f.ticks + f.fraction) * TICK_S
    way = Link()
    f.heard_by_anchors, f.heard, f.most_used = 0, 0, 0
    for node in range(f.nodes):
        station, noise = stations[node], noises[node]
        if node == f.sender or not station.is_on:
            continue
        find_link(f, stations, channel, barriers, f.sender, node, t_s, way)
        outcome = overlap_outcome(f, stations, channel, barriers, others, node, t_s, way)
        error_m = range_errors_m[node * f.anchors + f.sender]
        if outcome == _HEARD and error_m == _INFINITE:
            outcome = _WEAK
        elif outcome == _HEARD:
            outcome = reception_outcome(channel, noise, way.power_dbm)
        tally[(_OUTCOMES if station.is_tag else 0) + outcome] += 1
        if outcome == _HEARD:
            row, clock = heard[f.heard], clocks[node]
            row.node = node
            for axis in range(3):
                row.position_m[axis] = coordinate_m(station, axis, t_s)
            extra_m = extra_path_m(station.is_tag, channel, noise, f.bias_m)
            row.extra_m = way.delay_m + (extra_m + body_delay_m(stations[f.sender], station, t_s))
            if station.is_tag:
                error_m += slope_error_m(f.slope_m, way.distance_m)
            arrival_ticks = f.fraction + (way.distance_m + row.extra_m + error_m) / TICK_M
            if f.is_diagnosed:
                measure(clocks[f.sender], clock, channel, noise, way, row)
            error_ticks = station.rx_error_ticks + power_bias_m(way.power_dbm, power_biases_m) / TICK_M
            row.rx_ticks = stamp(clock, noise, station.rx_noise_ticks, f.ticks, arrival_ticks, error_ticks)
            row.reading_ticks = (clock.local_ticks & 127) + clock.local_fraction - error_m / TICK_M
            f.heard += 1
            if not station.is_tag:
                f.heard_by_anchors += 1
        f.most_used = max(f.most_used, noise.used)
