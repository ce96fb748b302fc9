"""The estimator's state: one record of fixed capacity, in which anchors join and leave by moving blocks.

The state vector, all clocks against the tag's own counter, in metres and m/s:

    values      position (dim), then for each anchor its clock's offset: tag's reading − anchor's reading (whole ticks
                are in ``Anchor``)
    rates       velocity (dim), then the rate of each offset
    tx noises   of each anchor's newest TX stamp, common to all who received it
    ambiguities for each anchor what its carrier phase shows beyond range and offset, once phases are in use
    meshes      for each anchor the difference between its clock as phases of relays show it and that of its stamps
    changes     for each anchor the part of the range error that changes as the tag moves
    constants   the part that stays
    slope       growth of ranges with distance
    height      true − given height of the tag, in 2-D
    zero        barometer reading − true height of the tag, in 3-D
    surveys     for each anchor (dim) its true position − its position in the almanac

Behind the tx noises, once a motion sensor is in use (``motion``):

    heading       cosine and sine of the angle from the sensor's level frame to the site's
    acceleration  (dim) what the sensor's accelerations lack in the site's frame: its bias, and its tilt times gravity

Range errors and surveys are last because many sites state that they are exact. Exact states have no variance and no
covariance and are left out of all arithmetic (``State.n``), until a jump or a fault proves otherwise. Everything
behind the states in use is zero.
"""

from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray

from skyless.core.estimator.settings import TUNING, EstimatorSettings, Tuning
from skyless.core.fix import PROTECTED_ROWS
from skyless.core.integrity import limits_of
from skyless.core.native.arithmetic import square
from skyless.core.native.records import (
    HYPOTHESES,
    MAX_ANCHORS,
    MOST_WAITING,
    MOTION_STATES,
    PACKED,
    PACKETS_KEPT,
    PHASE_STATES,
    PLANNED_FAULTS,
    SHARES_MEMORY,
    Array,
    Count,
    Integers,
    Matrix,
    Reals,
    Record,
    Ticks,
    record,
)
from skyless.core.native.views import aligned, view
from skyless.core.ticks import NEVER

LANES: Final = 1 if PACKED else 4
"""Numbers in a 256-bit vector; rows of P start at vector boundaries."""

AXES: Final = 3
HEADINGS: Final = 2
STATES: Final = (
    (2 * (AXES + MAX_ANCHORS) + (3 + PHASE_STATES + AXES) * MAX_ANCHORS + 2 + MOTION_STATES + LANES - 1)
    // LANES
    * LANES
)
"""Capacity for states; a multiple of ``LANES``."""
COVARIANCES: Final = STATES * (STATES + 1) // 2 if PACKED else STATES * STATES
MOST_TERMS: Final = 2 * (AXES + 3) + 8
"""Most terms of a measurement: a difference of two distances has the most."""

ROUNDING_M2: Final = 1e-7
"""Smaller variances of lasting faults may be rounding errors of single precision."""

LASTING, RECENT, CREEPING = range(3)
"""Kinds of faults: since the anchor joined, since its last few packets, or growing for seconds."""
FAULT_KINDS: Final = 3
FAULTS: Final = FAULT_KINDS * MAX_ANCHORS
SENSITIVITIES: Final = FAULTS + PLANNED_FAULTS + HYPOTHESES
"""Capacity for columns of V."""
WORK_ROWS: Final = MAX_ANCHORS + 1 + 2 * AXES


NO_RANGE_ERRORS, CHANGING_RANGE_ERRORS, ALL_RANGE_ERRORS = range(3)
"""Which range errors are uncertain: none, the changing ones, or all of them and the surveys."""

LEVELS: Final = 2 + FAULT_KINDS
"""Numbers written by ``levels.protect``: ``HPL``, ``VPL``, and the test of each kind of faults."""


@record
class Ambiguity(Record):
    """Record of an ambiguity beside its state."""

    is_known: bool
    refused_in_row: int
    """Consecutive phases beyond the gate."""
    ticks: Ticks
    """Tag time of its newest phase."""


@record
class Anchor(Record):
    """Record of an anchor beside its states."""

    identifier: int
    position_m: Annotated[Reals, AXES]
    tx_ticks: Ticks
    """Its newest packet's TX time, on its own clock."""
    rx_ticks: Ticks
    """Its newest packet's RX time, on the tag's clock."""
    offset_ticks: Ticks
    """Whole ticks of the offset."""
    range_m: float
    """Range at its newest packet."""
    held_m: Annotated[Reals, AXES]
    """Position at which ranges to it are linearised."""
    held_range_m: float
    """Range from there."""
    walked_m: float
    """The tag's walked distance at its newest packet."""
    is_relayed: bool
    """Whether others relay its packets."""
    has_rate: bool
    """Whether its clock's rate is known: the offset has been measured more than once."""
    has_tx_noise: bool
    """Whether its newest packet's TX noise is a state."""
    packets: Count
    innovation: float
    """Its newest innovation, normalised."""
    outliers_in_row: int
    outlier_m: float
    """Innovation of the newest outlier."""
    is_obstructed: bool
    """Whether its range error has jumped and not returned."""
    change_mean: float
    """Running mean of its normalised innovations since then."""
    change_scale: float
    """Factor on the process noise of a range error that has jumped."""
    ended_log_odds: float
    """Sum of the logarithms of odds that it has returned to zero, since they began to show it."""
    has_fault: bool
    """Whether a lasting fault of it has been added to the state."""
    relay_mean: float
    """Running mean of its clock's normalised innovations in relays."""
    walk_scale: float
    """Factor on its oscillator's random walk."""
    change_variance_m2: float
    """Variance of the changing part of its range error."""
    place_steps: int
    """Consecutive steps of the tag after which its range error was compared."""
    place_walked_m: float
    """The tag's walked distance at the newest step."""
    place_residual_m: Annotated[Reals, 2]
    """Residuals of its receptions after the last two steps."""
    own: Ambiguity
    """Ambiguity of the tag's receptions of it."""
    mesh: Ambiguity
    """Difference between its clock as phases of relays show it and that of its stamps."""
    rate_offset_ticks: Ticks
    """Its offset when rates of clocks were compared …"""
    rate_offset_m: float
    """… and the rest of it."""
    mean_rate_mps: float
    """Its mean rate from the comparison before."""
    rates: int
    """Consecutive comparisons that it took part in."""
    noise_ticks: Ticks
    """Tag time up to which P contains the noise of its own clock, if relays are processed in order."""
    phase_way_m: float
    """``Status.way_m`` at its newest phase."""


@record
class Hypotheses(Record):
    """Hypotheses on the cycles of phases (``hypotheses``); their deviations from x are columns of V behind the faults.

    Arrays have one element more than is used, as there may be no hypotheses at all.
    """

    count: int
    """1 if all cycles are certain; 0 as long as no phases are used."""
    weight: Annotated[Reals, HYPOTHESES + 1]
    log_weight: Annotated[Reals, HYPOTHESES + 1]
    """Logarithms of the present weights, up to a constant; ``weight`` is as of the newest mean."""
    found: int
    """Number of hypotheses that follow from these by a phase, the most likely first, and what each consists of."""
    new_log_weight: Annotated[Reals, HYPOTHESES + 1]
    parent: Annotated[Integers, HYPOTHESES + 1]
    shift_m: Annotated[Reals, HYPOTHESES + 1]
    old: Annotated[Reals, HYPOTHESES + 1]


@record
class KeptPacket(Record):
    """A packet that other anchors may relay."""

    sequence: int
    tx_ticks: Ticks
    rx_ticks: Ticks


@record
class Link(Record):
    """An ordered pair of anchors: listener and sender."""

    tx_ticks: Ticks
    """Newest packet of the sender whose reception by the listener was processed."""
    relays: Count
    """Relays used in this direction."""
    constant_m: float
    """Estimated constant of the pair, in the row of the lower index …"""
    variance_m2: float
    """… and its variance."""
    outliers_in_row: int
    contradicts: bool
    """Whether its range contradicts the survey."""
    has_phase: bool
    """Whether the constant of phases in this direction has been measured …"""
    phase_m: float
    """… its value modulo the wavelength …"""
    phase_variance_m2: float
    """… and its variance."""
    phases_refused: int
    """Consecutive phases beyond the gate."""


@record
class Motion(Record):
    """A motion sensor's attitude and path since the newest packet, in a level frame with a heading of its own."""

    lever_m: Annotated[Reals, AXES]
    """Position of the antenna seen from the sensor, in the sensor's frame."""
    has_states: bool
    """Whether heading and acceleration are states."""
    is_level: bool
    """Whether the attitude is known but for the heading."""
    has_force: bool
    """Whether samples have a specific force; wheels have none."""
    is_used: bool
    """Whether the newest time update was one by a specific force."""
    has_effect: bool
    """Whether the newest time update was one by the sensor or its wheels."""
    speed_nis: float
    """Running mean of the NIS of speeds, over a second."""
    wrong_s: float
    """Time for which innovations have called for much process noise."""
    contradictions: Count
    """How often that has lasted long."""
    ignored_ticks: Ticks
    """Tag time until which the sensor is ignored for it."""
    ticks: Ticks
    """Tag time of the newest sample that turned the attitude."""
    speed_ticks: Ticks
    """Tag time of the newest speed of wheels, …"""
    speed_mps: float
    """… along x of the sensor's frame."""
    used_ticks: Ticks
    """Tag time at which the path begins: that of the newest packet."""
    attitude: Annotated[Reals, 4]
    """Quaternion w, x, y, z that turns the sensor's frame into the level one."""
    level: Annotated[Reals, 4]
    """Quaternion that turned the first sample's frame into the level one; then that of the newest fix."""
    bias_rps: Annotated[Reals, AXES]
    """Bias of the gyroscope."""
    position_m: Annotated[Reals, AXES]
    """Path at the newest sample, against a uniform motion with the antenna's velocity where it begins."""
    velocity_mps: Annotated[Reals, AXES]
    rate_rps: Annotated[Reals, AXES]
    """The newest sample's rate, in the sensor's frame."""
    force_mps2: Annotated[Reals, AXES]
    """Its specific force, in the level frame."""
    arm_m: Annotated[Reals, AXES]
    """Position of the antenna against the sensor in the level frame …"""
    arm_mps: Annotated[Reals, AXES]
    """… and its velocity."""
    shown_m: Annotated[Reals, AXES]
    """Path of the antenna since the newest packet …"""
    shown_mps: Annotated[Reals, AXES]
    """… and the change of its velocity."""
    up_mps2: Annotated[Reals, AXES]
    """What a sensor at rest would show, for wheels."""
    mean_mps2: Annotated[Reals, AXES]
    """Running mean of the specific force."""
    rest_s: float
    """Time since the newest sample that showed motion."""
    level_s: float
    """Time over which the specific force has been averaged to find the level."""
    samples: Count
    """Samples that turned the attitude …"""
    speeds: Count
    """… speeds of wheels …"""
    late: Count
    """… those not in order, or too old when they came …"""
    gaps: Count
    """… and gaps after which level and heading were looked for again."""


@record
class Status(Record):
    """Counters and running means of the estimator."""

    epoch_ticks: Ticks
    """Tag time of the newest packet."""
    start_ticks: Ticks
    """Tag time of the start."""
    faded_ticks: Ticks
    """Tag time when faults that are not lasting were last faded."""
    packets: Count
    accepted: Count
    rejected: Count
    rejected_in_row: int
    stale: Count
    stale_in_row: int
    impossible: Count
    relays_used: Count
    relays_rejected: Count
    reports_used: Count
    reports_rejected: Count
    clock_restarts: Count
    obstructions: Count
    faults_opened: Count
    mean_nis: float
    mean_square_m2: float
    """Mean square of innovations."""
    rejected_share: float
    late_share: float
    relays_lately_accepted: float
    """Running counts that fade."""
    relays_lately_rejected: float
    lag: Annotated[Reals, AXES]
    """Running mean of innovations along each axis."""
    lag_square: float
    q_scale: float
    """Factor on qa."""
    common_mean: float
    """Running mean of all innovations, which shows the tag's own clock."""
    walk_scale: float
    """Factor on its random walk."""
    place_samples: int
    """Number of comparisons of range errors one step apart."""
    place_square_m2: Annotated[Reals, 2]
    """Half the mean square of their differences after one and after two steps."""
    place_variance_m2: float
    """Variance of range errors by multipath; 0 if no larger than stated."""
    place_distance_m: float
    """Distance over which multipath changes."""
    obstruction: float
    """1 if range errors have jumped recently, 0 if not."""
    walked_m: float
    stationary_s: float
    """Time since the tag last showed motion."""
    stationary_m: Annotated[Reals, AXES]
    """Its position then …"""
    stationary_m2: Annotated[Reals, AXES]
    """… and the variance along each axis."""
    withheld: int
    """``CONTRADICTED`` or ``UNAVAILABLE`` if levels are withheld from outside the filter, otherwise ``SOUND``."""
    height_ticks: Ticks
    """Tag time of the last height used from a sensor."""
    plane_m: Annotated[Reals, AXES]
    """A point of the plane that fits the anchors best."""
    plane_normal: Annotated[Reals, AXES]
    """Normal of that plane."""
    has_phases: bool
    """Whether phases are in use, so that there are ambiguities."""
    is_in_order: bool
    """Whether relays are processed before the reception of the packet that brings them, the oldest first."""
    rate_ticks: Ticks
    """Tag time at which rates of clocks were compared."""
    rate_changes: Count
    anchors_walk: float
    """Random walk of the anchors' clocks by changes of their rates [m²/s³]."""
    tag_walk: float
    """The same of the tag's."""
    recent_square: float
    """Square of the largest recent speed, with a memory of ``speed_memory_s``, while phases are in use."""
    line_m: Annotated[Reals, AXES]
    """Point at which phases are linearised: a position of the tag, moved from then on by its velocity alone."""
    step_m: Annotated[Reals, AXES]
    """The tag's position after its last step …"""
    way_m: float
    """… and the length of all steps: unlike ``walked_m`` it does not grow at rest."""
    phase_variance_m2: float
    """Variance of a phase, learnt from innovations."""
    wild_share: float
    """Running share of phases beyond the gate."""
    phases_used: Count
    phases_refused: Count
    phases_opened: Count
    """Ambiguities that began or restarted."""
    has_open_ranges: bool
    """Whether anchors join with range errors beyond those of the settings."""
    range_errors: int
    """``NO_RANGE_ERRORS``, ``CHANGING_RANGE_ERRORS`` or ``ALL_RANGE_ERRORS``."""
    fault_std_m: Annotated[Reals, FAULT_KINDS]
    """Prior standard deviation of each kind of faults."""


@record
class Layout(Record):
    """Index of the first state of each block."""

    offset: int
    """That of the first anchor; the others follow, as in all blocks."""
    velocity: int
    rate: int
    tx_noise: int
    heading: int
    acceleration: int
    """These two exist only with a motion sensor; without, they equal ``ambiguity`` and are not used."""
    ambiguity: int
    mesh: int
    """The last two exist only with phases; without, they equal ``change`` and are not used."""
    change: int
    constant: int
    slope: int
    height: int
    """In 2-D; in 3-D it is the position's third element."""
    zero: int
    """In 3-D; in 2-D it equals ``slope`` and is not used."""
    survey: int
    """``dim`` states for each anchor."""
    end: int


@record
class State(Record):
    """The estimator's state of one tag. What loops run over comes first, so that its rows fill cache lines."""

    x: Annotated[Reals, STATES]
    P: Annotated[Reals, COVARIANCES]
    """Row by row, symmetric to the bit; see ``at``."""
    V: Annotated[Matrix, STATES, SENSITIVITIES]
    """Sensitivity of x to faults: for each kind to each metre by which an anchor is received late, then to faults added
    by planning; or the deviations of hypotheses on cycles."""
    settings: EstimatorSettings
    tuning: Tuning
    horizontal_k: float
    """Standard deviations that cover the risk of the levels."""
    vertical_k: float
    dim: int
    """Dimensions of the position: 2 if the height is given, otherwise 3."""
    count: int
    """Number of anchors."""
    used: int
    """Number of uncertain states; all covariances with others are zero."""
    n: int
    """The same rounded up to a multiple of ``LANES``: the end of loops along rows of P."""
    rows: int
    """Columns of V in use."""
    layout: Layout
    status: Status
    motion: Motion
    hypotheses: Hypotheses
    information: Annotated[Matrix, FAULTS, FAULTS]
    """Information of the innovations on all faults, M; lower triangle."""
    evidence: Annotated[Reals, FAULTS]
    """Evidence of the innovations for all faults, y."""
    lasting_covariance: Annotated[Matrix, MAX_ANCHORS, MAX_ANCHORS]
    """Covariance of the lasting faults, (M + I/σ_f²)⁻¹, as M grows without limit and 1/σ_f² would be lost in it."""
    lasting_m: Annotated[Reals, MAX_ANCHORS]
    """Estimate of the lasting faults: that times y."""
    anchors: Annotated[Array[Anchor], MAX_ANCHORS]
    packets: Annotated[Array[Array[KeptPacket]], MAX_ANCHORS, PACKETS_KEPT]
    links: Annotated[Array[Array[Link]], MAX_ANCHORS, MAX_ANCHORS]
    """By listener and sender."""
    terms: int
    """Terms of the current measurement, in ``h``."""
    h: Annotated[Reals, MOST_TERMS]
    """Nonzero elements of the current measurement, at the indices in ``h_index``."""
    h_index: Annotated[Integers, MOST_TERMS]
    waiting: int
    """Queued updates, not yet in P and V: a packet's relays are applied together."""
    U: Annotated[Matrix, MOST_WAITING, STATES]
    """u = P·h/√S of each queued update, then P·h of the current measurement."""
    G: Annotated[Matrix, MOST_WAITING, SENSITIVITIES]
    """Fault inputs over √S of each queued update, then those of the current measurement."""
    shows_faults: Annotated[Reals, MOST_WAITING]
    """1 for queued updates by measurements that show faults, and 0 for the others."""
    work: Annotated[Matrix, WORK_ROWS, MAX_ANCHORS]
    """Scratch for systems of equations of all faults of one kind."""
    levels: Annotated[Reals, LEVELS]
    fix: Annotated[Matrix, PROTECTED_ROWS, AXES]
    """Rows of a fix (``POSITION`` and the following)."""


# Indices of the covariances


def row_of(state: int) -> int:
    """Index in P of a state's row."""
    return state * (state + 1) >> 1 if PACKED else state * STATES


def row_end(state: int, end: int) -> int:
    """Length of a row of P up to ``end``: the whole row, or up to the diagonal."""
    return min(state + 1, end) if PACKED else end


def at(one: int, other: int) -> int:
    """Index in P of the covariance of two states."""
    return row_of(other) + one if PACKED and other > one else row_of(one) + other


def set_covariance(s: State, one: int, other: int, value: float) -> None:
    """Write the covariance of two states; if P is square, in both places."""
    s.P[at(one, other)] = value
    if not PACKED:
        s.P[at(other, one)] = value


def covariances(s: State) -> NDArray[Any]:
    """P as a square NumPy array; a copy if it is packed."""
    P = view(s.P)
    states = np.arange(STATES)
    return P[np.vectorize(at)(*np.ix_(states, states))] if PACKED else P.reshape(STATES, STATES)


def new_state(settings: EstimatorSettings) -> State:
    """A state without anchors at the origin; see ``Estimator.start``."""
    s = aligned(State)
    s.settings, s.tuning = settings, TUNING
    s.horizontal_k, s.vertical_k = limits_of(settings.integrity_risk)
    s.dim = settings.dim
    prepare(s)
    return s


def restart(s: State, rx_ticks: Ticks, late_share: float, fault_std_m: float, has_open_ranges: bool) -> None:
    """Start again without anchors at the origin, with the same settings.

    ``fault_std_m``: range errors of all anchors that the levels have to cover. ``has_open_ranges``: expect range errors
    of half a metre and misplaced anchors, because the settings have been contradicted.
    """
    status = Status()
    _clear(s)
    s.status = status
    s.status.has_open_ranges = has_open_ranges
    prepare(s)
    s.status.late_share, s.status.fault_std_m[LASTING] = late_share, fault_std_m
    s.status.epoch_ticks = s.status.start_ticks = s.status.faded_ticks = rx_ticks


def _clear(s: State) -> None:
    """Clear all states and anchors. Unused memory is zero already unless a search has used it."""
    states, rows, count = s.layout.end, s.rows, s.count
    if SHARES_MEMORY:
        states, rows, count = STATES, SENSITIVITIES, MAX_ANCHORS
    for state in range(states):
        s.x[state] = 0.0
        for other in range(states):
            s.P[at(state, other)] = 0.0
        for row in range(rows):
            s.V[state][row] = 0.0
    for fault in range(FAULT_KINDS * count):
        s.evidence[fault] = 0.0
        for other in range(FAULT_KINDS * count):
            s.information[fault][other] = 0.0
    for anchor in range(count):
        s.lasting_m[anchor] = 0.0
        for other in range(count):
            s.lasting_covariance[anchor][other] = 0.0
    for row in range(PROTECTED_ROWS):
        for axis in range(AXES):
            s.fix[row][axis] = 0.0
    s.count = s.waiting = s.hypotheses.count = 0


def prepare(s: State) -> None:
    """Initialise a state that is zero except for its settings and dimensions."""
    status, settings, tuning = s.status, s.settings, s.tuning
    stamps_m2 = settings.tx_variance_m2 + settings.rx_variance_m2
    status.q_scale = status.mean_nis = s.hypotheses.weight[0] = 1.0
    status.height_ticks = NEVER
    status.walk_scale = tuning.start_walk_scale
    status.fault_std_m[LASTING] = tuning.lasting_std_m
    status.fault_std_m[RECENT] = tuning.recent_std_m
    status.fault_std_m[CREEPING] = tuning.creeping_std_m
    status.place_square_m2[0] = status.place_square_m2[1] = status.mean_square_m2 = stamps_m2
    status.place_distance_m = settings.place_distance_m
    status.wild_share = tuning.start_wild
    status.phase_variance_m2 = square(max(tuning.phase_start_std_m, settings.phase_std_m))
    if settings.place_std_m > 0.0:
        status.range_errors = CHANGING_RANGE_ERRORS
    stated = max(settings.survey_std_m, settings.range_std_m, settings.slope_std_m, settings.height_std_m)
    if status.has_open_ranges or stated > 0.0:
        status.range_errors = ALL_RANGE_ERRORS
    set_layout(s)
    if MOTION_STATES > 0:
        expect_motion(s)
    s.P[at(s.layout.slope, s.layout.slope)] = square(settings.slope_std_m)
    if s.dim == 2:
        s.P[at(s.layout.height, s.layout.height)] = square(settings.height_std_m)


def set_layout(s: State) -> None:
    """Compute the layout for the present number of anchors."""
    where, count, dim = s.layout, s.count, s.dim
    where.offset = dim
    where.velocity = dim + count
    where.rate = where.velocity + dim
    where.tx_noise = where.rate + count
    where.heading = where.tx_noise + count
    where.acceleration = where.heading + (HEADINGS if s.motion.has_states else 0)
    where.ambiguity = where.acceleration + (dim if s.motion.has_states else 0)
    ambiguities = count if s.status.has_phases else 0
    where.mesh = where.ambiguity + ambiguities
    where.change = where.mesh + ambiguities
    where.constant = where.change + count
    where.slope = where.constant + count
    where.height = where.slope + 1 if dim == 2 else 2
    where.zero = where.slope if dim == 2 else where.slope + 1
    where.survey = where.slope + 2
    where.end = where.survey + dim * count
    s.rows = FAULT_KINDS * count + s.hypotheses.count
    make_uncertain(s, s.status.range_errors)


def make_uncertain(s: State, range_errors: int) -> None:
    """Treat at least these range errors as uncertain, and update the number of uncertain states."""
    s.status.range_errors = max(s.status.range_errors, range_errors)
    end = s.layout.change
    if s.status.range_errors == CHANGING_RANGE_ERRORS:
        end = s.layout.constant
    elif s.status.range_errors == ALL_RANGE_ERRORS:
        end = s.layout.end
    s.used = end
    s.n = (end + LANES - 1) // LANES * LANES


# Anchors join and leave


def find_anchor(s: State, identifier: int) -> int:
    """The index of an anchor in the state, or −1."""
    for anchor in range(s.count):
        if s.anchors[anchor].identifier == identifier:
            return anchor
    return -1


def add_anchor(s: State, identifier: int, position_m: Reals, std_m: float, is_open: bool) -> int:
    """Add an anchor with an unknown clock and, if ``is_open``, an unknown range error. Returns its index.

    ``std_m``: survey standard deviation of each coordinate; the settings' if negative. There must be room.
    """
    settings, tuning, dim, anchor = s.settings, s.tuning, s.dim, s.count
    where, a = s.layout, s.anchors[anchor]
    for _ in range(dim):
        _insert_state(s, where.end)
    _insert_state(s, where.slope)  # from the last block to the first, as each index is behind those inserted before
    _insert_state(s, where.constant)
    if s.status.has_phases:
        _insert_state(s, where.change)
        _insert_state(s, where.mesh)
    _insert_state(s, where.heading)
    _insert_state(s, where.tx_noise)
    _insert_state(s, where.velocity)
    for kind in range(FAULT_KINDS):
        _insert_fault(s, (FAULT_KINDS - kind) * anchor, FAULT_KINDS * anchor + kind)
    s.count += 1
    set_layout(s)
    s.anchors[anchor] = Anchor()
    a.identifier = identifier
    for axis in range(AXES):
        a.position_m[axis] = position_m[axis]
    a.tx_ticks = a.rx_ticks = NEVER
    a.walk_scale = 1.0
    a.change_variance_m2 = square(settings.place_std_m)
    s.lasting_covariance[anchor][anchor] = square(s.status.fault_std_m[LASTING])
    for kept in range(PACKETS_KEPT):
        packet = s.packets[anchor][kept]
        packet.sequence = -1
        packet.tx_ticks = packet.rx_ticks = NEVER
    has_errors = settings.range_std_m > 0.0 or settings.survey_std_m > 0.0 or std_m > 0.0
    for other in range(s.count):
        _clear_link(s.links[anchor][other], square(tuning.open_pair_std_m) if has_errors else 0.0)
        _clear_link(s.links[other][anchor], square(tuning.open_pair_std_m) if has_errors else 0.0)
    range_std_m, survey_std_m = settings.range_std_m, settings.survey_std_m if std_m < 0.0 else std_m
    if is_open or s.status.has_open_ranges:
        range_std_m, survey_std_m = tuning.late_std_m, tuning.open_survey_std_m
    if survey_std_m > 0.0:
        make_uncertain(s, ALL_RANGE_ERRORS)
    s.P[at(where.change + anchor, where.change + anchor)] = a.change_variance_m2
    s.P[at(where.constant + anchor, where.constant + anchor)] = square(range_std_m)
    for axis in range(dim):
        survey = where.survey + dim * anchor + axis
        s.P[at(survey, survey)] = square(survey_std_m)
    return anchor


def use_phases(s: State) -> None:
    """Add ambiguities for all anchors, none of them known yet."""
    if not s.status.has_phases:
        for _ in range(2 * s.count):
            _insert_state(s, s.layout.change)
        s.status.has_phases = s.status.is_in_order = True
        s.hypotheses.count = 1
        set_layout(s)
        for anchor in range(s.count):
            s.anchors[anchor].noise_ticks = s.status.epoch_ticks


def use_motion(s: State) -> None:
    """Add heading and acceleration of a motion sensor, both unknown."""
    if not s.motion.has_states:
        for _ in range(HEADINGS + s.dim):
            _insert_state(s, s.layout.ambiguity)
        s.motion.has_states = True
        set_layout(s)
        expect_motion(s)


def expect_motion(s: State) -> None:
    """Reset heading and acceleration of a motion sensor, if there is one, to what is known of any sensor."""
    where, tuning = s.layout, s.tuning
    s.motion.used_ticks = NEVER
    for state in range(where.heading, where.ambiguity):
        s.x[state] = 0.0
        for other in range(s.used):
            set_covariance(s, state, other, 0.0)
        for row in range(s.rows):
            s.V[state][row] = 0.0
        std = tuning.heading_std if state < where.acceleration else tuning.acceleration_std_mps2
        s.P[at(state, state)] = square(std) * (tuning.vertical_share if state == where.acceleration + 2 else 1.0)


def _clear_link(link: Link, variance_m2: float) -> None:
    """Reset a link to no relays."""
    link.tx_ticks = NEVER
    link.constant_m = 0.0
    link.variance_m2 = variance_m2
    link.outliers_in_row = 0
    link.relays = 0
    link.contradicts = False
    forget_pair_phase(link)


def forget_pair_phase(link: Link) -> None:
    """Forget the constant of phases in a direction of a pair."""
    link.has_phase, link.phases_refused = False, 0
    link.phase_m = link.phase_variance_m2 = 0.0


def remove_anchor(s: State, anchor: int) -> None:
    """Remove an anchor from the state."""
    where, dim, last = s.layout, s.dim, s.count - 1
    for _ in range(dim):
        _remove_state(s, where.survey + dim * anchor)
    _remove_state(s, where.constant + anchor)
    _remove_state(s, where.change + anchor)
    if s.status.has_phases:
        _remove_state(s, where.mesh + anchor)
        _remove_state(s, where.ambiguity + anchor)
    _remove_state(s, where.tx_noise + anchor)
    _remove_state(s, where.rate + anchor)
    _remove_state(s, where.offset + anchor)
    _remove_lasting(s, anchor)
    for kind in range(FAULT_KINDS):
        _remove_fault(s, (FAULT_KINDS - 1 - kind) * s.count + anchor, FAULT_KINDS * s.count - kind)
    for moved in range(anchor, last):
        s.anchors[moved] = s.anchors[moved + 1]
        for kept in range(PACKETS_KEPT):
            s.packets[moved][kept] = s.packets[moved + 1][kept]
        for other in range(s.count):
            s.links[moved][other] = s.links[moved + 1][other]
    for moved in range(anchor, last):
        for other in range(last):
            s.links[other][moved] = s.links[other][moved + 1]
    s.count = last
    set_layout(s)


def _insert_state(s: State, index: int) -> None:
    """Move all states from an index on back by one, and set the state at the index to zero."""
    end = s.layout.end
    for state in range(end, index, -1):
        s.x[state] = s.x[state - 1]
        for row in range(s.rows):
            s.V[state][row] = s.V[state - 1][row]
    s.x[index] = 0.0
    for row in range(s.rows):
        s.V[index][row] = 0.0
    for state in range(end, -1, -1):
        to, source = row_of(state), row_of(state - 1 if state > index else state)
        for other in range(row_end(state, end + 1) - 1, -1, -1):
            s.P[to + other] = s.P[source + (other - 1 if other > index else other)]
    for other in range(end + 1):
        set_covariance(s, index, other, 0.0)
    s.layout.end = end + 1


def _remove_state(s: State, index: int) -> None:
    """Move all states behind an index forward by one."""
    end = s.layout.end
    for state in range(index, end - 1):
        s.x[state] = s.x[state + 1]
        for row in range(s.rows):
            s.V[state][row] = s.V[state + 1][row]
    s.x[end - 1] = 0.0
    for row in range(s.rows):
        s.V[end - 1][row] = 0.0
    for state in range(end - 1):
        to, source = row_of(state), row_of(state + 1 if state >= index else state)
        for other in range(row_end(state, end - 1)):
            s.P[to + other] = s.P[source + (other + 1 if other >= index else other)]
    for other in range(end):
        set_covariance(s, end - 1, other, 0.0)
    s.layout.end = end - 1


def _insert_fault(s: State, index: int, faults: int) -> None:
    """Move all faults from an index on back by one, and set the fault at the index to zero."""
    for state in range(s.layout.end):
        _insert(s.V[state], index, s.rows)
    s.rows += 1
    for row in range(faults, index, -1):
        for other in range(faults):
            s.information[row][other] = s.information[row - 1][other]
    for other in range(faults):
        s.information[index][other] = 0.0
    for row in range(faults + 1):
        _insert(s.information[row], index, faults)
    _insert(s.evidence, index, faults)


def _remove_fault(s: State, index: int, faults: int) -> None:
    """Move all faults behind an index forward by one."""
    for state in range(s.layout.end):
        _remove(s.V[state], index, s.rows)
    s.rows -= 1
    for row in range(index, faults - 1):
        for other in range(faults):
            s.information[row][other] = s.information[row + 1][other]
    for other in range(faults):
        s.information[faults - 1][other] = 0.0
    for row in range(faults):
        _remove(s.information[row], index, faults)
    _remove(s.evidence, index, faults)


def _remove_lasting(s: State, anchor: int) -> None:
    """Remove an anchor from the lasting faults, given that it has none."""
    covariance, end = s.lasting_covariance, s.count
    _weigh_zero(s, anchor, 1.0 / ROUNDING_M2)
    for row in range(anchor, end - 1):
        for other in range(end):
            covariance[row][other] = covariance[row + 1][other]
    for other in range(end):
        covariance[end - 1][other] = 0.0
    for row in range(end):
        _remove(covariance[row], anchor, end)
    _remove(s.lasting_m, anchor, end)


def _insert(numbers: Reals, index: int, end: int) -> None:
    """Move numbers from an index up to an end back by one, and set the number at the index to zero."""
    for place in range(end, index, -1):
        numbers[place] = numbers[place - 1]
    numbers[index] = 0.0


def _remove(numbers: Reals, index: int, end: int) -> None:
    """Move numbers behind an index forward by one."""
    for place in range(index, end - 1):
        numbers[place] = numbers[place + 1]
    numbers[end - 1] = 0.0


# Lasting faults


def learn_lasting(s: State, m: Reals, weight: float, shown: float) -> None:
    """Add weight·m·mᵀ to M of the lasting faults and weight·m·shown to y (Sherman and Morrison 1950)."""
    c, variance, innovation = s.work[1], 1.0, shown
    for one in range(s.count):
        total, row = 0.0, s.lasting_covariance[one]
        for other in range(s.count):
            total += row[other] * m[other]
        c[one] = total
        variance += weight * m[one] * total
        innovation -= m[one] * s.lasting_m[one]
    gain = weight / variance
    for one in range(s.count):
        share, row = gain * c[one], s.lasting_covariance[one]
        s.lasting_m[one] += share * innovation
        for other in range(s.count):
            row[other] -= share * c[other]


def forget_lasting(s: State, anchor: int) -> None:
    """Reset a lasting fault to its prior, because it has become a state of its own."""
    variance = square(s.status.fault_std_m[LASTING])
    _weigh_zero(s, anchor, 1.0 / square(s.tuning.late_std_m) - 1.0 / variance)
    for other in range(s.count):
        s.lasting_covariance[anchor][other] = s.lasting_covariance[other][anchor] = 0.0
    s.lasting_covariance[anchor][anchor] = variance
    s.lasting_m[anchor] = 0.0


def _weigh_zero(s: State, anchor: int, weight: float) -> None:
    """Add the information, with this weight, that an anchor's lasting fault is zero."""
    m = s.work[2]
    for one in range(s.count):
        m[one] = 1.0 if one == anchor else 0.0
    learn_lasting(s, m, weight, 0.0)
