"""Cold start: the tag's first position, from packets alone and without an initial guess.

When anchor i relays its reception of a packet of anchor j that the tag received too, the offset between the two
anchors' clocks at that moment is known up to noise. Along such links all TX times are converted to the clock of one
anchor. The tag's clock is up to 20 ppm off, so pseudoranges drift by tens of metres within one superframe. Two packets
of the same anchor measure that drift; the newest pseudoranges of all anchors are then propagated to a common time and
solved in closed form.
"""

from typing import Annotated, Final

from skyless.core.estimator.process import Packet, Relay, Relays, ScaledTime, relay_rx_ticks
from skyless.core.estimator.settings import Tuning
from skyless.core.native.arithmetic import floor, sqrt, square
from skyless.core.native.records import MAX_ANCHORS, RELAYS_KEPT, Array, Integers, Matrix, Reals, Record, Ticks, record
from skyless.core.tag.position import FOUND, MIRROR, RESIDUALS, Found, find_position
from skyless.core.tag.search import LARGEST, LocateProblem
from skyless.core.ticks import MAX_DRIFT, NEVER, SPEED_OF_LIGHT_MPS, TICK_M, TICK_S

UNUSABLE, TOO_FEW_ANCHORS, ACQUIRING = range(20, 23)
"""Reasons for no start, in addition to those of ``find_position``. ``UNUSABLE``: the input is out of range."""

MAX_LINKS: Final = MAX_ANCHORS * (MAX_ANCHORS - 1)


@record
class HeardPacket(Record):
    """A received packet with the relays that it carried."""

    packet: Packet
    relay_count: int
    relays: Annotated[Array[Relay], RELAYS_KEPT]
    scaled: ScaledTime
    """TX time on the common scale of the current attempt."""


@record
class HeardAnchor(Record):
    """An anchor's two newest packets."""

    count: int
    fitted_ticks: Ticks
    """Tag time when the anchor was last on the common scale with a plausible clock rate."""
    older: HeardPacket
    newer: HeardPacket


@record
class ClockLink(Record):
    """Listener's clock minus sender's clock at the tag's time ``rx_ticks_tag``."""

    listener: int
    sender: int
    rx_ticks_tag: Ticks
    ticks: Ticks
    fraction_ticks: float


@record
class Reach(Record):
    """Tree of links that lead from each anchor's clock to the reference anchor's."""

    count: int
    order: Annotated[Integers, MAX_ANCHORS]
    """Pairs in breadth-first order; the first is the reference."""
    is_reached: Annotated[Integers, MAX_ANCHORS]
    parent: Annotated[Integers, MAX_ANCHORS]
    link: Annotated[Integers, MAX_ANCHORS]
    sign: Annotated[Integers, MAX_ANCHORS]


@record
class Start(Record):
    """A start: the first position and its covariance."""

    rx_ticks_tag: Ticks
    count: int
    used: Annotated[Integers, MAX_ANCHORS]
    """Indices into ``heard`` of the anchors used."""
    position_m: Annotated[Reals, 3]
    covariance_m2: Annotated[Matrix, 3, 3]
    is_contradicted: bool
    """Whether the packets of all anchors are inconsistent with each other."""
    has_misfit: bool
    misfit: int
    """The excluded anchor; the others agree without it."""


@record
class Acquisition(Record):
    """Gathers packets until a start is possible."""

    knows_height: bool
    height_m: float
    has_bounds: bool
    low_m: float
    high_m: float
    variance_m2: float
    """Variance of a TX and an RX timestamp together."""
    max_age_s: float
    start_age_s: float
    """Packets that are older are used only for rates."""
    speed_std_mps: float
    """Assumed standard deviation of the tag's speed."""
    error_variance_m2: float
    """Variance of survey and range errors."""
    tuning: Tuning
    count: int
    heard: Annotated[Array[HeardAnchor], MAX_ANCHORS]
    """In the order in which they were first heard."""
    link_count: int
    links: Annotated[Array[ClockLink], MAX_LINKS]
    has_been_wide: bool
    wide_ticks: Ticks
    """Time of the first start that was too wide to use."""
    is_contradicted: bool
    contradicted_ticks: Ticks
    """When packets first contradicted each other."""
    rival_count: int
    """Number of anchors when two positions last fitted equally well; the same number is retried once a superframe."""
    start: Start
    # Scratch space of one attempt
    pair_count: int
    pairs: Annotated[Integers, MAX_ANCHORS]
    """Indices into ``heard`` of the anchors with two packets."""
    # Rate of each anchor's clock relative to the tag's, as a fraction, and its variance in m²/s².
    rates: Annotated[Reals, MAX_ANCHORS]
    rate_variances: Annotated[Reals, MAX_ANCHORS]
    clock_rates_mps: Annotated[Reals, MAX_ANCHORS]
    """Rate of the tag's clock against the common scale, measured with each anchor; ``_solve_start`` sorts them."""
    reach: Reach
    best: Reach
    found_alone: Start
    # Pseudoranges at a common time, and their variances.
    ranges_m: Annotated[Reals, MAX_ANCHORS]
    variances_m2: Annotated[Reals, MAX_ANCHORS]
    problem: LocateProblem
    found: Found


def forget_all(q: Acquisition) -> None:
    """Forget all packets."""
    q.count = q.link_count = 0


def forget_packets(q: Acquisition, anchor: int) -> None:
    """Forget an anchor's packets and links."""
    place = _find_heard(q, anchor)
    if place >= 0:
        _remove_heard(q, place)
    kept = 0
    for one in range(q.link_count):
        if q.links[one].listener != anchor and q.links[one].sender != anchor:
            q.links[kept] = q.links[one]
            kept += 1
    q.link_count = kept


def try_start(q: Acquisition, packet: Packet, relays: Relays) -> int:
    """Add a packet and, if its anchor was heard before, try to start.

    Returns ``FOUND`` if ``q.start`` is a start, otherwise the reason why not.
    """
    now, anchor = packet.rx_ticks, packet.place.anchor
    _forget_old_packets(q, now)
    came_around = gather_packet(q, packet, relays)
    _choose_pairs(q, now)
    _put_on_one_scale(q, now)
    _drop_impossible(q, now)
    needed = 3 if q.knows_height else 4
    if q.pair_count < needed:
        return TOO_FEW_ANCHORS if q.count < needed else ACQUIRING
    is_first = _anchor_of(q, 0) == anchor
    if not came_around or (q.pair_count == q.rival_count and not is_first):
        return MIRROR if q.rival_count > 0 else ACQUIRING
    reason = _solve_start(q, -1, now, q.tuning.start_tail)
    q.rival_count = q.pair_count if reason == MIRROR else 0
    if reason == FOUND:
        if not _is_wide(q):
            return FOUND
        if not q.has_been_wide:
            q.has_been_wide, q.wide_ticks = True, q.start.rx_ticks_tag
        return ACQUIRING if _is_worth_waiting(q) else FOUND
    if reason == MIRROR or q.pair_count <= needed + 1 or not is_first:
        return reason
    return _solve_without_one(q, now)


# Packets and links


def _find_heard(q: Acquisition, anchor: int) -> int:
    for place in range(q.count):
        if q.heard[place].newer.packet.place.anchor == anchor:
            return place
    return -1


def _remove_heard(q: Acquisition, place: int) -> None:
    q.count -= 1
    for one in range(place, q.count):
        q.heard[one] = q.heard[one + 1]


def _forget_old_packets(q: Acquisition, now: Ticks) -> None:
    for place in range(q.count - 1, -1, -1):
        if (now - q.heard[place].newer.packet.rx_ticks) * TICK_S > q.max_age_s:
            _remove_heard(q, place)


def gather_packet(q: Acquisition, packet: Packet, relays: Relays) -> bool:
    """Keep a packet without trying to start. Returns True if two packets of its anchor were kept already.

    If the table is full, a new anchor replaces the one that has not fitted the others for longest.
    """
    _add_links(q, packet, relays)
    place = _find_heard(q, packet.place.anchor)
    if place < 0:
        if q.count == MAX_ANCHORS:
            _remove_heard(q, _longest_unfitting(q))
        place = q.count
        q.count += 1
        q.heard[place].count, q.heard[place].fitted_ticks = 0, NEVER
    one = q.heard[place]
    had_two = one.count == 2
    if one.count > 0:
        one.older = one.newer
    one.newer.packet = packet
    one.newer.relay_count = min(relays.count, RELAYS_KEPT)
    for relayed in range(one.newer.relay_count):
        one.newer.relays[relayed] = relays.rows[relayed]
    one.count = min(one.count + 1, 2)
    return had_two


def _longest_unfitting(q: Acquisition) -> int:
    longest = 0
    for place in range(1, q.count):
        if q.heard[place].fitted_ticks < q.heard[longest].fitted_ticks:
            longest = place
    return longest


def _add_links(q: Acquisition, packet: Packet, relays: Relays) -> None:
    """Keep the relays that concern packets the tag has received itself."""
    for index in range(relays.count):
        relayed = relays.rows[index]
        place = _find_heard(q, relayed.anchor)
        if place >= 0:
            if q.heard[place].newer.packet.sequence == relayed.sequence:
                _add_link(q, packet, q.heard[place].newer.packet, relayed)
            elif q.heard[place].count == 2 and q.heard[place].older.packet.sequence == relayed.sequence:
                _add_link(q, packet, q.heard[place].older.packet, relayed)


def _add_link(q: Acquisition, listener: Packet, sent: Packet, relayed: Relay) -> None:
    rx_ticks = relay_rx_ticks(relayed, listener.tx_ticks, listener.rx_ticks - sent.rx_ticks)
    total = 0.0
    for axis in range(3):
        total += square(listener.place.position_m[axis] - sent.place.position_m[axis])
    index = 0
    while index < q.link_count and not (
        q.links[index].listener == listener.place.anchor and q.links[index].sender == sent.place.anchor
    ):
        index += 1
    if index == MAX_LINKS:
        index = _oldest_link(q)
    q.link_count = max(q.link_count, index + 1)
    link = q.links[index]
    link.listener, link.sender, link.rx_ticks_tag = listener.place.anchor, sent.place.anchor, sent.rx_ticks
    link.ticks, link.fraction_ticks = rx_ticks - sent.tx_ticks, -sqrt(total) / TICK_M


def _oldest_link(q: Acquisition) -> int:
    oldest = 0
    for index in range(1, q.link_count):
        if q.links[index].rx_ticks_tag < q.links[oldest].rx_ticks_tag:
            oldest = index
    return oldest


def _forget_links_before(q: Acquisition, now: Ticks) -> None:
    kept = 0
    for one in range(q.link_count):
        if (now - q.links[one].rx_ticks_tag) * TICK_S < 2.0 * q.max_age_s:
            q.links[kept] = q.links[one]
            kept += 1
    q.link_count = kept


def _choose_pairs(q: Acquisition, now: Ticks) -> None:
    """Choose the anchors with two packets of which the newer is recent."""
    q.pair_count = 0
    for place in range(q.count):
        age_s = (now - q.heard[place].newer.packet.rx_ticks) * TICK_S
        if q.heard[place].count == 2 and age_s < q.start_age_s:
            q.pairs[q.pair_count] = place
            q.pair_count += 1


def _anchor_of(q: Acquisition, pair: int) -> int:
    return q.heard[q.pairs[pair]].newer.packet.place.anchor


# One scale for all TX times


def _put_on_one_scale(q: Acquisition, now: Ticks) -> None:
    """Convert TX times to the clock of the anchor that reaches most others; leave the others out."""
    for pair in range(q.pair_count):
        one = q.heard[q.pairs[pair]]
        _measure_rate(q, pair, one.older.packet, one.newer.packet)
    _forget_links_before(q, now)
    q.best.count = 0
    for pair in range(q.pair_count):
        if q.best.count == 0 or q.best.is_reached[pair] == 0:  # it would reach the same anchors as before
            _reach_from(q, pair)
            if q.reach.count > q.best.count:
                q.best = q.reach
    kept = 0
    for pair in range(q.pair_count):
        one = q.heard[q.pairs[pair]]
        if q.best.is_reached[pair] == 1:
            _convert(q, pair, one.older)
            _convert(q, pair, one.newer)
            q.clock_rates_mps[kept] = _clock_rate_mps(one)
            q.pairs[kept] = q.pairs[pair]
            kept += 1
    q.pair_count = kept


def _measure_rate(q: Acquisition, pair: int, first: Packet, second: Packet) -> None:
    elapsed = second.rx_ticks - first.rx_ticks
    q.rates[pair] = q.rate_variances[pair] = 0.0
    if elapsed > 0:
        q.rates[pair] = (second.tx_ticks - first.tx_ticks - elapsed) / elapsed
        q.rate_variances[pair] = 2.0 * q.variance_m2 / square(elapsed * TICK_S)


def _reach_from(q: Acquisition, reference: int) -> None:
    """Build the tree of links from ``reference`` to every anchor it reaches, each by the fewest links."""
    r = q.reach
    for pair in range(q.pair_count):
        r.is_reached[pair] = 0
    r.count, r.order[0], r.is_reached[reference] = 1, reference, 1
    r.parent[reference] = -1
    next_one = 0
    while next_one < r.count:
        known = r.order[next_one]
        anchor = _anchor_of(q, known)
        for index in range(q.link_count):
            link = q.links[index]
            is_listener = link.listener == anchor
            if is_listener or link.sender == anchor:
                other = _find_pair(q, link.sender if is_listener else link.listener)
                if other >= 0 and r.is_reached[other] == 0:
                    r.is_reached[other], r.parent[other], r.link[other] = 1, known, index
                    r.sign[other] = 1 if is_listener else -1
                    r.order[r.count] = other
                    r.count += 1
        next_one += 1


def _find_pair(q: Acquisition, anchor: int) -> int:
    for pair in range(q.pair_count):
        if _anchor_of(q, pair) == anchor:
            return pair
    return -1


def _convert(q: Acquisition, pair: int, one: HeardPacket) -> None:
    """Convert a packet's TX time to the reference clock; each link is propagated with the two clocks' rates."""
    r, rx_ticks = q.best, one.packet.rx_ticks
    ticks, fraction, variance_m2 = one.packet.tx_ticks, 0.0, 0.0
    place = pair
    while r.parent[place] >= 0:
        link, parent = q.links[r.link[place]], r.parent[place]
        elapsed = rx_ticks - link.rx_ticks_tag
        ticks += r.sign[place] * link.ticks
        fraction += r.sign[place] * link.fraction_ticks + (q.rates[parent] - q.rates[place]) * elapsed
        rate_variance = q.rate_variances[parent] + q.rate_variances[place]
        variance_m2 += 2.0 * q.variance_m2 + rate_variance * square(elapsed * TICK_S)
        place = parent
    whole = floor(fraction)
    one.scaled.ticks, one.scaled.fraction_ticks, one.scaled.variance_m2 = ticks + whole, fraction - whole, variance_m2


def _clock_rate_mps(one: HeardAnchor) -> float:
    """Rate of the tag's clock against the common scale in m/s, from two packets; c if they are out of order."""
    elapsed = one.newer.packet.rx_ticks - one.older.packet.rx_ticks
    if elapsed <= 0:
        return SPEED_OF_LIGHT_MPS
    change_ticks = elapsed - (one.newer.scaled.ticks - one.older.scaled.ticks)
    change_m = (change_ticks - (one.newer.scaled.fraction_ticks - one.older.scaled.fraction_ticks)) * TICK_M
    return change_m / (elapsed * TICK_S)


def _drop_impossible(q: Acquisition, now: Ticks) -> None:
    """Drop pairs of packets whose clock rate no crystal can have."""
    kept = 0
    for pair in range(q.pair_count):
        if abs(q.clock_rates_mps[pair]) <= MAX_DRIFT * SPEED_OF_LIGHT_MPS:
            q.clock_rates_mps[kept], q.pairs[kept] = q.clock_rates_mps[pair], q.pairs[pair]
            q.heard[q.pairs[kept]].fitted_ticks = now
            kept += 1
    q.pair_count = kept


# Positions


def _solve_start(q: Acquisition, left_out: int, now: Ticks, residual_tail: float) -> int:
    """Locate the tag from the newest packets of all pairs but ``left_out`` (−1: all). Returns ``FOUND`` or a reason."""
    if q.pair_count < 3 + (1 if left_out >= 0 else 0):
        return TOO_FEW_ANCHORS
    start, count = q.start, 0
    shortest_s = q.max_age_s
    for pair in range(q.pair_count):
        if pair != left_out:
            one = q.heard[q.pairs[pair]]
            rate_mps, place = _clock_rate_mps(one), count
            while place > 0 and q.clock_rates_mps[place - 1] > rate_mps:
                q.clock_rates_mps[place] = q.clock_rates_mps[place - 1]
                place -= 1
            q.clock_rates_mps[place] = rate_mps
            shortest_s = min(shortest_s, (one.newer.packet.rx_ticks - one.older.packet.rx_ticks) * TICK_S)
            start.used[count] = q.pairs[pair]
            count += 1
    median_mps = 0.5 * (q.clock_rates_mps[count // 2] + q.clock_rates_mps[(count - 1) // 2])
    rate_variance = 2.0 * q.variance_m2 / square(shortest_s) + square(q.speed_std_mps)
    reference = q.heard[start.used[0]].newer
    base_ticks = reference.packet.rx_ticks - reference.scaled.ticks
    for index in range(count):
        newest = q.heard[start.used[index]].newer
        age_s = (now - newest.packet.rx_ticks) * TICK_S
        whole = newest.packet.rx_ticks - newest.scaled.ticks - base_ticks
        q.ranges_m[index] = (whole - newest.scaled.fraction_ticks) * TICK_M + median_mps * age_s
        aged_m2 = square(age_s) * (rate_variance / count + square(q.speed_std_mps))
        stamps_m2 = newest.packet.variance_factor * q.variance_m2 + newest.scaled.variance_m2
        q.variances_m2[index] = stamps_m2 + q.error_variance_m2 + aged_m2
    reason = _locate(q, count, residual_tail)
    if reason == FOUND:
        start.count, start.rx_ticks_tag = count, now
        start.is_contradicted = start.has_misfit = False
        for axis in range(3):
            start.position_m[axis] = q.found.position_m[axis]
            for other in range(3):
                start.covariance_m2[axis][other] = q.found.covariance_m2[axis][other]
    return reason


def _locate(q: Acquisition, count: int, residual_tail: float) -> int:
    """Locate the tag from differences to the first pseudorange, whose variance they share."""
    p = q.problem
    p.anchors, p.knows_height, p.height_m, p.is_weighted = count, q.knows_height, q.height_m, True
    p.has_bounds, p.low_m, p.high_m, p.residual_tail = q.has_bounds, q.low_m, q.high_m, residual_tail
    for i in range(count):
        place = q.heard[q.start.used[i]].newer.packet.place
        difference_m = q.ranges_m[i] - q.ranges_m[0]
        is_usable = abs(difference_m) < LARGEST and 0.0 < q.variances_m2[i] < LARGEST
        for axis in range(3):
            p.anchors_m[i][axis] = place.position_m[axis]
            is_usable = is_usable and abs(place.position_m[axis]) < LARGEST
        if not is_usable:
            return UNUSABLE
        if i > 0:
            p.tdoa_m[i - 1] = difference_m
            row = (i - 1) * i // 2
            for j in range(i):
                p.covariance[row + j] = q.variances_m2[0] + (q.variances_m2[i] if j == i - 1 else 0.0)
    return find_position(p, q.found)


def _is_wide(q: Acquisition) -> bool:
    """Whether the curvature of the ranges within the start's standard deviation exceeds their noise.

    The linearised updates would then make the filter overconfident in a wrong position.
    """
    start, dims = q.start, 2 if q.knows_height else 3
    range_m = 0.0
    for index in range(start.count):
        total = 0.0
        for axis in range(dims):
            total += square(q.heard[start.used[index]].newer.packet.place.position_m[axis] - start.position_m[axis])
        range_m += sqrt(total) / start.count
    curvature_m = 0.5 * (start.covariance_m2[0][0] + start.covariance_m2[1][1]) / range_m
    return not square(curvature_m) < q.variance_m2 + q.error_variance_m2


def _is_worth_waiting(q: Acquisition) -> bool:
    """Whether a wide start is withheld: more anchors may still be heard, or too few support it."""
    start, dims = q.start, 2 if q.knows_height else 3
    waited_s = (start.rx_ticks_tag - q.wide_ticks) * TICK_S
    return start.count <= dims + 1 or waited_s <= q.tuning.start_patience_s


def _solve_without_one(q: Acquisition, now: Ticks) -> int:
    """Exclude an anchor if it is the only one without which the others agree; enough must remain to detect a misfit.

    If there is no such anchor for ``start_patience_s``, start from all of them.
    """
    if not q.is_contradicted:
        q.is_contradicted, q.contradicted_ticks = True, now
    starts = 0
    for pair in range(q.pair_count):
        if _solve_start(q, pair, now, q.tuning.start_tail) == FOUND:
            starts += 1
            q.found_alone = q.start
            q.found_alone.has_misfit, q.found_alone.misfit = True, _anchor_of(q, pair)
    reason = FOUND
    if starts == 1:
        q.start = q.found_alone
    elif (now - q.contradicted_ticks) * TICK_S < q.tuning.start_patience_s:
        return RESIDUALS
    else:
        reason = _solve_start(q, -1, now, 0.0)
    q.start.is_contradicted = reason == FOUND
    return reason
