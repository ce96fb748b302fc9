"""The estimator's state: one record of fixed capacity, and how anchors join and leave by moving blocks in it.

The state vector, all clocks against the tag's own counter, in metres and m/s:

    values      position (dim), then for each anchor the offset of its clock: tag's reading − anchor's reading (its
                whole ticks stand in ``Anchor``)
    rates       velocity (dim), then the rate of each offset
    tx noises   of each anchor's newest TX stamp, which all who received it share
    ambiguities for each anchor what its carrier's phase shows beyond range and offset, once phases are used
    meshes      for each anchor the ambiguity of its own receptions of its partner, another anchor
    formers     for each anchor its ambiguity up to a gap, while it is not known by how many cycles it has changed since
    changes     for each anchor the part of the tag's range error to it that changes as the tag moves
    constants   the part that stays
    slope       how ranges lengthen with distance
    height      the tag's true height − the one that is given, in two dimensions
    zero        what a barometer reads − the tag's true height, in three dimensions
    surveys     for each anchor (dim) its true position − its position in the almanac

Range errors and surveys stand last because many a site calls them exact. What is exact has no variance and no
covariance, so it is left out of all arithmetic (``State.n``), until a jump or a fault shows otherwise. All that stands
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
    MAX_ANCHORS,
    MOST_WAITING,
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
"""Numbers in a vector of 256 bits, where rows of P begin at one."""

AXES: Final = 3
STATES: Final = 2 * (AXES + MAX_ANCHORS) + (3 + PHASE_STATES + AXES) * MAX_ANCHORS + 2
"""Capacity for states; a multiple of ``LANES``."""
COVARIANCES: Final = STATES * (STATES + 1) // 2 if PACKED else STATES * STATES
MOST_TERMS: Final = 2 * (AXES + 3) + 8
"""Most terms of a measurement: a difference of two distances has the most."""

ROUNDING_M2: Final = 1e-7
"""What rounding in single precision may make of a variance of lasting faults that is smaller."""

LASTING, RECENT, CREEPING = range(3)
"""Kinds of faults: there since an anchor joined, begun within its last packets, or growing for seconds."""
FAULT_KINDS: Final = 3
FAULTS: Final = FAULT_KINDS * MAX_ANCHORS
SENSITIVITIES: Final = FAULTS + AXES + PLANNED_FAULTS
"""Capacity for columns of V."""
WORK_ROWS: Final = MAX_ANCHORS + 1 + 2 * AXES


NO_RANGE_ERRORS, CHANGING_RANGE_ERRORS, ALL_RANGE_ERRORS = range(3)
"""Which range errors are not known to be zero: none, those that change, or all of them, and surveys."""

LEVELS: Final = 2 + FAULT_KINDS
"""Numbers that ``levels.protect`` writes: ``HPL``, ``VPL``, and the tests of all kinds of faults."""


@record
class Ambiguity(Record):
    """What is kept of an ambiguity in addition to its state."""

    is_known: bool
    refused_in_row: int
    """Phases beyond the gate."""
    ticks: Ticks
    """The tag's reading at its newest phase."""


@record
class Anchor(Record):
    """What is kept of an anchor in addition to its states."""

    identifier: int
    position_m: Annotated[Reals, AXES]
    tx_ticks: Ticks
    """Newest packet, by its own clock."""
    rx_ticks: Ticks
    """Newest packet, by the tag's clock."""
    offset_ticks: Ticks
    """Whole ticks of the offset."""
    range_m: float
    """At its newest packet."""
    held_m: Annotated[Reals, AXES]
    """The tag's position at which ranges to it are linearised."""
    held_range_m: float
    """Distance of that point."""
    walked_m: float
    """The tag's walked distance at its newest packet."""
    is_relayed: bool
    """Whether others relay its packets."""
    has_rate: bool
    """Whether its clock's rate is known: more than its first packet has shown its offset."""
    has_tx_noise: bool
    """Whether its newest packet's TX noise is a state."""
    packets: Count
    innovation: float
    """Its newest one, normalised."""
    outliers_in_row: int
    outlier_m: float
    """The newest of them."""
    is_obstructed: bool
    """Whether its range error has jumped and not come back."""
    change_mean: float
    """Running mean of its innovations since then, normalised."""
    change_scale: float
    """Factor on the process noise of a range error that has jumped."""
    has_fault: bool
    """Whether a lasting fault of it was added to the state."""
    relay_mean: float
    """Running mean of what relays show of its clock, normalised."""
    walk_scale: float
    """Factor on its oscillator's random walk."""
    change_variance_m2: float
    """Of the part of its range error that changes as the tag moves."""
    place_steps: int
    """Steps of the tag after which its range error was compared, in a row."""
    place_walked_m: float
    """The tag's walked distance at the newest of them."""
    place_residual_m: Annotated[Reals, 2]
    """What its reception left after the last two."""
    own: Ambiguity
    """Of the tag's receptions of it."""
    mesh: Ambiguity
    """Of its receptions of its partner."""
    partner: int
    """Identifier of that, −1 for none."""
    has_former: bool
    former_ticks: Ticks
    """The tag's reading when its former ambiguity ended."""
    phase_way_m: float
    """The tag's way at its newest phase."""


@record
class KeptPacket(Record):
    """A packet that others may relay."""

    sequence: int
    tx_ticks: Ticks
    rx_ticks: Ticks


@record
class Link(Record):
    """A pair of anchors, listener and sender."""

    tx_ticks: Ticks
    """Newest packet of the sender whose reception by the listener was processed."""
    relays: Count
    """Used in this direction."""
    constant_m: float
    """Estimated constant of the pair, in the row of the lower index."""
    variance_m2: float
    """Variance of that."""
    outliers_in_row: int
    contradicts: bool
    """Whether its range contradicts the survey."""


@record
class Status(Record):
    """The estimator's counters and running means."""

    epoch_ticks: Ticks
    """The tag's reading at the newest packet."""
    start_ticks: Ticks
    """The tag's reading at the start."""
    faded_ticks: Ticks
    """The tag's reading when faults that are not lasting last faded."""
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
    ends_of_obstructions: Count
    faults_opened: Count
    mean_nis: float
    mean_square_m2: float
    """Of innovations."""
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
    """Running mean of all innovations: the tag's own clock."""
    walk_scale: float
    """Factor on its random walk."""
    place_samples: int
    """Comparisons of range errors at places a step apart."""
    place_square_m2: Annotated[Reals, 2]
    """Half their mean square after one and two steps."""
    place_variance_m2: float
    """Of what multipath changes in them, 0 where not more than stated."""
    place_distance_m: float
    """Distance over which multipath changes."""
    obstruction: float
    """1 where range errors have jumped recently, 0 where they do not."""
    walked_m: float
    stationary_s: float
    """Since the tag last showed motion."""
    stationary_m: Annotated[Reals, AXES]
    """Where it was then."""
    stationary_m2: Annotated[Reals, AXES]
    """Variance of that on each axis."""
    withholds_levels: bool
    """Whether the anchors' positions are known to be wrong."""
    height_ticks: Ticks
    """The tag's reading when a sensor's height was used last."""
    plane_m: Annotated[Reals, AXES]
    """A point of the plane that lies closest to the anchors."""
    plane_normal: Annotated[Reals, AXES]
    """Normal of that plane."""
    has_phases: bool
    """Whether phases are used, so that there are ambiguities."""
    line_m: Annotated[Reals, AXES]
    """Where phases are linearised: a place of the tag, from there on moved by its velocity alone."""
    step_m: Annotated[Reals, AXES]
    """The tag's place after its last step …"""
    way_m: float
    """… and the sum of all steps: unlike ``walked_m`` it does not grow at rest."""
    phase_variance_m2: float
    """Of a phase, as innovations show it."""
    wild_share: float
    """Running share of phases beyond the gate."""
    phases_used: Count
    phases_refused: Count
    phases_opened: Count
    """Ambiguities that began, or began again …"""
    phases_rejoined: Count
    """… and of these the ones of which it was then found by how many cycles they differ from the former."""
    has_open_ranges: bool
    """Whether anchors join with range errors beyond those of the settings."""
    range_errors: int
    """NO_RANGE_ERRORS, CHANGING_RANGE_ERRORS or ALL_RANGE_ERRORS."""
    fault_std_m: Annotated[Reals, FAULT_KINDS]
    """Of each kind of faults, beforehand."""


@record
class Layout(Record):
    """Where the states stand: the index of the first of each block."""

    offset: int
    """Of the first anchor; the others' follow, as in all blocks."""
    velocity: int
    rate: int
    tx_noise: int
    ambiguity: int
    mesh: int
    former: int
    """All where phases are used; else they are the change's place, and not used."""
    change: int
    constant: int
    slope: int
    height: int
    """In two dimensions; in three it is one of the position."""
    zero: int
    """In three dimensions; in two it is the slope's place, and not used."""
    survey: int
    """``dim`` states for each anchor."""
    end: int


@record
class State(Record):
    """Everything that the estimator keeps of one tag. What loops run over stands first: its rows fill cache lines."""

    x: Annotated[Reals, STATES]
    P: Annotated[Reals, COVARIANCES]
    """Row by row, symmetric to the bit; see ``at``."""
    V: Annotated[Matrix, STATES, SENSITIVITIES]
    """What faults do to x: of each kind for each metre by which receptions of an anchor are late, then for each m/s² of
    acceleration along an axis, then what planning adds."""
    settings: EstimatorSettings
    tuning: Tuning
    horizontal_k: float
    """How many standard deviations the risk of levels allows."""
    vertical_k: float
    dim: int
    """Dimensions of the position: 2 where the height is given, else 3."""
    count: int
    """Anchors in the state."""
    used: int
    """States that are not known to be exact; covariances with all others are zero."""
    n: int
    """The same up to a multiple of ``LANES``: what loops along rows of P go to."""
    rows: int
    """Columns of V in use."""
    layout: Layout
    status: Status
    information: Annotated[Matrix, FAULTS, FAULTS]
    """Information of the innovations on all faults; the lower half."""
    evidence: Annotated[Reals, FAULTS]
    """What innovations show of them."""
    lasting_covariance: Annotated[Matrix, MAX_ANCHORS, MAX_ANCHORS]
    """Of the lasting faults: (M + I/σ_f²)⁻¹. Their M grows without end, next to which 1/σ_f² would be lost."""
    lasting_m: Annotated[Reals, MAX_ANCHORS]
    """Their estimate: that times y."""
    anchors: Annotated[Array[Anchor], MAX_ANCHORS]
    packets: Annotated[Array[Array[KeptPacket]], MAX_ANCHORS, PACKETS_KEPT]
    links: Annotated[Array[Array[Link]], MAX_ANCHORS, MAX_ANCHORS]
    """Of listener and sender."""
    terms: int
    """Terms of the measurement at hand, which stand in ``h``."""
    h: Annotated[Reals, MOST_TERMS]
    """The measurement where it is not zero, at the indices in ``h_index``."""
    h_index: Annotated[Integers, MOST_TERMS]
    waiting: int
    """Updates that are not in P and V yet: those of a packet's relays go there together."""
    U: Annotated[Matrix, MOST_WAITING, STATES]
    """Of each its u = P·h/√S; then P·h of the measurement at hand."""
    G: Annotated[Matrix, MOST_WAITING, SENSITIVITIES]
    """Of each, over √S, by how much each fault is in its innovation; then the same of the measurement at hand."""
    work: Annotated[Matrix, WORK_ROWS, MAX_ANCHORS]
    """Scratch for systems of equations of all faults of one kind."""
    levels: Annotated[Reals, LEVELS]
    fix: Annotated[Matrix, PROTECTED_ROWS, AXES]
    """What a fix carries (``POSITION`` and the following)."""


# Where the covariances stand


def row_of(state: int) -> int:
    """Where a state's row of P begins."""
    return state * (state + 1) >> 1 if PACKED else state * STATES


def row_end(state: int, end: int) -> int:
    """How many of the first elements of a row of P there are: all, or those up to the diagonal."""
    return min(state + 1, end) if PACKED else end


def at(one: int, other: int) -> int:
    """Where the covariance of two states stands in P."""
    return row_of(other) + one if PACKED and other > one else row_of(one) + other


def set_covariance(s: State, one: int, other: int, value: float) -> None:
    """Write the covariance of two states, in both places where P has two."""
    s.P[at(one, other)] = value
    if not PACKED:
        s.P[at(other, one)] = value


def covariances(s: State) -> NDArray[Any]:
    """P as NumPy sees it, square: a copy where it is packed."""
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
    """Begin again without anchors at the origin, with the same settings.

    ``fault_std_m``: of range errors of all anchors that the levels are to cover; ``has_open_ranges``: expect ranges to
    be wrong by half a metre and anchors to be misplaced, since what the settings assume of them has been contradicted.
    """
    status = Status()
    _clear(s)
    s.status = status
    s.status.has_open_ranges = has_open_ranges
    prepare(s)
    s.status.late_share, s.status.fault_std_m[LASTING] = late_share, fault_std_m
    s.status.epoch_ticks = s.status.start_ticks = s.status.faded_ticks = rx_ticks


def _clear(s: State) -> None:
    """Forget all states and anchors. What is not in use is zero already, unless a search has used the memory."""
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
    s.count = s.waiting = 0


def prepare(s: State) -> None:
    """Initialise a state that is all zeros but for its settings and dimensions."""
    status, settings, tuning = s.status, s.settings, s.tuning
    stamps_m2 = settings.tx_variance_m2 + settings.rx_variance_m2
    status.q_scale = status.mean_nis = 1.0
    status.height_ticks = NEVER
    status.walk_scale = tuning.start_walk_scale
    status.fault_std_m[LASTING] = tuning.lasting_std_m
    status.fault_std_m[RECENT] = tuning.recent_std_m
    status.fault_std_m[CREEPING] = tuning.creeping_std_m
    status.place_square_m2[0] = status.place_square_m2[1] = status.mean_square_m2 = stamps_m2
    status.place_distance_m = settings.place_distance_m
    status.phase_variance_m2 = square(max(tuning.phase_start_std_m, settings.phase_std_m))
    if settings.place_std_m > 0.0:
        status.range_errors = CHANGING_RANGE_ERRORS
    stated = max(settings.survey_std_m, settings.range_std_m, settings.slope_std_m, settings.height_std_m)
    if status.has_open_ranges or stated > 0.0:
        status.range_errors = ALL_RANGE_ERRORS
    set_layout(s)
    s.P[at(s.layout.slope, s.layout.slope)] = square(settings.slope_std_m)
    if s.dim == 2:
        s.P[at(s.layout.height, s.layout.height)] = square(settings.height_std_m)


def set_layout(s: State) -> None:
    """Find where the states stand with the present number of anchors."""
    where, count, dim = s.layout, s.count, s.dim
    where.offset = dim
    where.velocity = dim + count
    where.rate = where.velocity + dim
    where.tx_noise = where.rate + count
    where.ambiguity = where.tx_noise + count
    ambiguities = count if s.status.has_phases else 0
    where.mesh = where.ambiguity + ambiguities
    where.former = where.mesh + ambiguities
    where.change = where.former + ambiguities
    where.constant = where.change + count
    where.slope = where.constant + count
    where.height = where.slope + 1 if dim == 2 else 2
    where.zero = where.slope if dim == 2 else where.slope + 1
    where.survey = where.slope + 2
    where.end = where.survey + dim * count
    s.rows = FAULT_KINDS * count + dim
    make_uncertain(s, s.status.range_errors)


def make_uncertain(s: State, range_errors: int) -> None:
    """From now on at least these range errors are not known to be zero; finds the number of uncertain states."""
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
    """Let an anchor join, of whose clock and, if it is open, range error nothing is known; its index.

    ``std_m``: of each coordinate of this anchor; below 0 for that of the settings. There must be room.
    """
    settings, tuning, dim, anchor = s.settings, s.tuning, s.dim, s.count
    where, a = s.layout, s.anchors[anchor]
    for _ in range(dim):
        _insert_state(s, where.end)
    _insert_state(s, where.slope)  # behind the block of constants, and so on: from the last to the first
    _insert_state(s, where.constant)
    if s.status.has_phases:
        _insert_state(s, where.change)
        _insert_state(s, where.former)
        _insert_state(s, where.mesh)
    _insert_state(s, where.ambiguity)
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
    a.partner = -1
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
    """From now on there are ambiguities, all of which are still to begin."""
    if not s.status.has_phases:
        for _ in range(3 * s.count):
            _insert_state(s, s.layout.change)
        s.status.has_phases = True
        set_layout(s)


def _clear_link(link: Link, variance_m2: float) -> None:
    """Nothing has been relayed from one anchor to another yet."""
    link.tx_ticks = NEVER
    link.constant_m = 0.0
    link.variance_m2 = variance_m2
    link.outliers_in_row = 0
    link.relays = 0
    link.contradicts = False


def remove_anchor(s: State, anchor: int) -> None:
    """Let an anchor leave the state."""
    where, dim, last = s.layout, s.dim, s.count - 1
    for _ in range(dim):
        _remove_state(s, where.survey + dim * anchor)
    _remove_state(s, where.constant + anchor)
    _remove_state(s, where.change + anchor)
    if s.status.has_phases:
        _remove_state(s, where.former + anchor)
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
    """Move all states from an index on one place back; the one that is there then is zero."""
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
    """Move all states behind an index one place forward."""
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
    """Move all faults from an index on one place back; the one that is there then is zero."""
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
    """Move all faults behind an index one place forward."""
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
    """The same of what is known of lasting faults, given that this anchor has none."""
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
    """Move numbers from an index up to an end one place back."""
    for place in range(end, index, -1):
        numbers[place] = numbers[place - 1]
    numbers[index] = 0.0


def _remove(numbers: Reals, index: int, end: int) -> None:
    """Move numbers behind an index one place forward."""
    for place in range(index, end - 1):
        numbers[place] = numbers[place + 1]
    numbers[end - 1] = 0.0


# What is known of lasting faults


def learn_lasting(s: State, m: Reals, weight: float, shown: float) -> None:
    """M of the lasting faults gains weight·m·mᵀ, and y weight·m·shown (Sherman and Morrison 1950)."""
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
    """The lasting fault of an anchor becomes a state, with its own variance beforehand; another one may follow."""
    variance = square(s.status.fault_std_m[LASTING])
    _weigh_zero(s, anchor, 1.0 / square(s.tuning.late_std_m) - 1.0 / variance)
    for other in range(s.count):
        s.lasting_covariance[anchor][other] = s.lasting_covariance[other][anchor] = 0.0
    s.lasting_covariance[anchor][anchor] = variance
    s.lasting_m[anchor] = 0.0


def _weigh_zero(s: State, anchor: int, weight: float) -> None:
    """It is known with this weight besides that the lasting fault of an anchor is zero."""
    m = s.work[2]
    for one in range(s.count):
        m[one] = 1.0 if one == anchor else 0.0
    learn_lasting(s, m, weight, 0.0)
