"""The estimator's state: what is estimated, data of each anchor, and how anchors join and leave.

The state vector, all clocks against the tag's own counter, in metres and m/s:

    values      position (dim), then for each anchor the offset of its clock: tag's reading − anchor's reading (its
                whole ticks stand in ``ANCHOR_DTYPE``)
    rates       velocity (dim), then the rate of each offset
    tx noises   of each anchor's newest TX stamp, which all who received it share
    changes     for each anchor the part of the tag's range error to it that changes as the tag moves
    constants   the part that stays
    slope       how ranges lengthen with distance
    height      the tag's true height − the one that is given, in two dimensions
    zero        what a barometer reads − the tag's true height, in three dimensions
    surveys     for each anchor (dim) its true position − its position in the almanac

Range errors and surveys stand last because many a site calls them exact. What is exact has no variance and no
covariance, so ``uncertain_states`` leaves it out of all arithmetic, until a jump or a fault shows otherwise.
"""

from collections.abc import Mapping
from typing import Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from skyless.core.estimator.settings import TUNING, EstimatorSettings
from skyless.core.kernels.arrays import Indices, Integers, Matrix, Records, Vector
from skyless.core.kernels.compiled import jitted, step

# The state


Scalar = TypeVar("Scalar", bound=np.generic)

# Packets of each anchor that are kept for relays to come; divides the range of sequence numbers.
PACKETS_KEPT: Final = 16
LANES: Final = 8  # numbers in the longest vectors of processors

NO_RANGE_ERRORS, CHANGING_RANGE_ERRORS, ALL_RANGE_ERRORS = range(3)
"""Which range errors are not known to be zero: none, those that change, or all of them, and surveys."""

NEVER: Final = -(1 << 62)
"""A time before all others."""

ANCHOR_DTYPE: Final = np.dtype(
    [
        ("table_index", np.int64),
        ("position_m", np.float64, (3,)),
        ("tx_ticks", np.int64),  # newest packet, by its own clock
        ("rx_ticks", np.int64),  # newest packet, by the tag's clock
        ("offset_ticks", np.int64),  # whole ticks of the offset
        ("range_m", np.float64),  # at its newest packet
        ("held_m", np.float64, (3,)),  # the tag's position at which ranges to it are linearised
        ("held_range_m", np.float64),  # distance of that point
        ("walked_m", np.float64),  # the tag's walked distance at its newest packet
        ("is_relayed", np.int64),  # whether others relay its packets
        ("has_tx_noise", np.int64),  # whether its newest packet's TX noise is a state
        ("packets", np.int64),
        ("innovation", np.float64),  # its newest one, normalised
        ("outliers_in_row", np.int64),
        ("outlier_m", np.float64),  # the newest of them
        ("is_obstructed", np.int64),  # whether its range error has jumped and not come back
        ("change_mean", np.float64),  # running mean of its innovations since then, normalised
        ("change_scale", np.float64),  # factor on the process noise of a range error that has jumped
        ("has_fault", np.int64),  # whether a lasting fault of it was added to the state
        ("relay_outliers_in_row", np.int64),
        ("relay_mean", np.float64),  # running mean of what relays show of its clock, normalised
        ("walk_scale", np.float64),  # factor on its oscillator's random walk
        ("change_variance_m2", np.float64),  # of the part of its range error that changes as the tag moves
        ("place_steps", np.int64),  # steps of the tag after which its range error was compared, in a row
        ("place_walked_m", np.float64),  # the tag's walked distance at the newest of them
        ("place_residual_m", np.float64, (2,)),  # what its reception left after the last two
    ],
    align=True,
)
"""What is kept of an anchor in addition to its states."""

PACKET_DTYPE: Final = np.dtype([("sequence", np.int64), ("tx_ticks", np.int64), ("rx_ticks", np.int64)], align=True)
"""A packet that others may relay."""

LINK_DTYPE: Final = np.dtype(
    [
        ("tx_ticks", np.int64),  # newest packet of the sender whose reception by the listener was processed
        ("constant_m", np.float64),  # estimated constant of the pair, in the row of the lower index
        ("variance_m2", np.float64),  # variance of that
        ("outliers_in_row", np.int64),
        ("relays", np.int64),  # used in this direction
        ("contradicts", np.int64),  # whether its range contradicts the survey
    ],
    align=True,
)
"""A pair of anchors, listener and sender."""

LASTING, RECENT, CREEPING = range(3)
"""Kinds of faults: there since an anchor joined, begun within its last packets, or growing for seconds."""
FAULT_KINDS: Final = 3

STATUS_DTYPE: Final = np.dtype(
    [
        ("epoch_ticks", np.int64),  # the tag's reading at the newest packet
        ("start_ticks", np.int64),  # the tag's reading at the start
        ("faded_ticks", np.int64),  # the tag's reading when faults that are not lasting last faded
        ("outcome", np.int64),  # what became of it
        ("packets", np.int64),
        ("accepted", np.int64),
        ("rejected", np.int64),
        ("rejected_in_row", np.int64),
        ("stale", np.int64),
        ("stale_in_row", np.int64),
        ("impossible", np.int64),
        ("relays_used", np.int64),
        ("relays_rejected", np.int64),
        ("reports_used", np.int64),
        ("reports_rejected", np.int64),
        ("clock_restarts", np.int64),
        ("obstructions", np.int64),
        ("ends_of_obstructions", np.int64),
        ("faults_opened", np.int64),
        ("mean_nis", np.float64),
        ("mean_square_m2", np.float64),  # of innovations
        ("rejected_share", np.float64),
        ("late_share", np.float64),
        ("relays_lately_accepted", np.float64),  # running counts that fade
        ("relays_lately_rejected", np.float64),
        ("lag", np.float64, (3,)),  # running mean of innovations along each axis
        ("lag_square", np.float64),
        ("q_scale", np.float64),  # factor on qa
        ("common_mean", np.float64),  # running mean of all innovations: the tag's own clock
        ("walk_scale", np.float64),  # factor on its random walk
        ("place_samples", np.int64),  # comparisons of range errors at places a step apart
        ("place_square_m2", np.float64, (2,)),  # half their mean square after one and two steps
        ("place_variance_m2", np.float64),  # of what multipath changes in them, 0 where not more than stated
        ("place_distance_m", np.float64),  # distance over which multipath changes
        ("obstruction", np.float64),  # 1 where range errors have jumped recently, 0 where they do not
        ("walked_m", np.float64),
        ("stationary_s", np.float64),  # since the tag last showed motion
        ("stationary_m", np.float64, (3,)),  # where it was then
        ("stationary_m2", np.float64, (3,)),  # variance of that on each axis
        ("withholds_levels", np.int64),  # whether the anchors' positions are known to be wrong
        ("height_ticks", np.int64),  # the tag's reading when a sensor's height was used last
        ("plane_m", np.float64, (3,)),  # a point of the plane that lies closest to the anchors
        ("plane_normal", np.float64, (3,)),  # normal of that plane
        ("open_range_errors", np.int64),  # whether anchors join with range errors beyond those of the settings
        ("range_errors", np.int64),  # NO_RANGE_ERRORS, CHANGING_RANGE_ERRORS or ALL_RANGE_ERRORS
        ("fault_std_m", np.float64, (FAULT_KINDS,)),  # of each kind of faults, beforehand
    ],
    align=True,
)
"""The estimator's counters and running means."""


class EstimatorState(NamedTuple):
    """Everything that the kernels work on, for one tag with its anchors and n states (``Layout.room``)."""

    x: Vector
    """Shape (n,)."""
    P: Matrix
    """Shape (n, n), symmetric to the bit."""
    V: Matrix
    """What faults do to x, shape (FAULT_KINDS·anchors + dim, n): of each kind for each metre by which receptions of an
    anchor are late, then for each m/s² of acceleration along an axis."""
    information: Matrix
    """Information of the innovations on all faults, shape (FAULT_KINDS·anchors, FAULT_KINDS·anchors)."""
    evidence: Vector
    """What innovations show of them, shape (FAULT_KINDS·anchors,)."""
    anchors: Records
    """``ANCHOR_DTYPE``, shape (anchors,)."""
    packets: Records
    """``PACKET_DTYPE``, shape (anchors, PACKETS_KEPT)."""
    links: Records
    """``LINK_DTYPE``, shape (anchors, anchors), listener and sender."""
    status: Records
    """``STATUS_DTYPE``, shape (1,)."""
    settings: Records
    """``SETTINGS_DTYPE``, shape (1,)."""
    index_of: Integers
    """Index among ``anchors`` of each anchor of the site's table, −1 for those that are not in the state."""
    h: Vector
    """The measurement at hand where it is not zero, at the indices in ``h_index``."""
    h_index: Indices
    ph: Vector
    """P·h of the measurement at hand, shape (n,)."""
    fault_input: Vector
    """By how much each fault is in the present innovation, shape (2·anchors + dim,)."""
    work: Matrix
    """Scratch for systems of equations of all faults of one kind, shape (anchors + 1 + dim, anchors)."""


class Layout(NamedTuple):
    """Where the states of n anchors stand."""

    offset: int
    """Index of the first anchor's offset. The others' follow, as in all blocks."""
    velocity: int
    rate: int
    tx_noise: int
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
    room: int
    """Length of arrays of states: ``end`` up to a multiple of ``LANES``, so that rows fill whole vectors."""


@jitted
def layout(dim: int, anchors: int) -> Layout:
    """Where what stands."""
    values = dim + anchors
    behind = 2 * values
    slope = behind + 3 * anchors
    height, zero = (slope + 1, slope) if dim == 2 else (2, slope + 1)
    survey = slope + 2
    end = survey + dim * anchors
    return Layout(
        dim, values, values + dim, behind, behind + anchors, behind + 2 * anchors, slope, height, zero, survey, end,
        -(-end // LANES) * LANES,
    )  # fmt: skip


@jitted
def direction_terms(dim: int) -> int:
    """Terms of a distance: the position, the anchor's survey error and, in two dimensions, the height's error."""
    return dim + 3


def most_terms(dim: int) -> int:
    """Most terms of a measurement: a difference of two distances has the most."""
    return 2 * direction_terms(dim) + 8


@step
def uncertain_states(s: EstimatorState) -> int:
    """How many states count: all that follow are exact, and their covariances with others are zero.

    A multiple of ``LANES``.
    """
    where, range_errors = layout(s.settings[0]["dim"], len(s.anchors)), s.status[0]["range_errors"]
    end = where.constant if range_errors == CHANGING_RANGE_ERRORS else where.change
    end = where.end if range_errors == ALL_RANGE_ERRORS else end
    return int(-(-end // LANES) * LANES)


def _expected_range_errors(settings: Records, status: Records) -> int:
    """Which of them there are from the beginning."""
    names = ("survey_std_m", "range_std_m", "slope_std_m", "height_std_m")
    if status["open_range_errors"] or any(settings[name] > 0.0 for name in names):
        return ALL_RANGE_ERRORS
    return CHANGING_RANGE_ERRORS if settings["place_std_m"] > 0.0 else NO_RANGE_ERRORS


def new_state(settings: EstimatorSettings, table_size: int, *, open_range_errors: bool = False) -> EstimatorState:
    """A state without anchors at the origin, for a table of that size; see ``Estimator.start``."""
    dim = settings.dim
    where = layout(dim, 0)
    n = where.room
    status = np.zeros(1, STATUS_DTYPE)
    status["open_range_errors"] = open_range_errors
    status["range_errors"] = _expected_range_errors(settings.record()[0], status[0])
    status["q_scale"] = status["mean_nis"] = 1.0
    status["height_ticks"] = NEVER
    status["walk_scale"] = min(TUNING.start_walk_scale, settings.max_walk_scale)
    status["fault_std_m"] = (TUNING.lasting_std_m, TUNING.recent_std_m, TUNING.creeping_std_m)
    status["place_square_m2"] = settings.tx_variance_m2 + settings.rx_variance_m2
    status["place_distance_m"] = settings.place_distance_m
    status["mean_square_m2"] = settings.tx_variance_m2 + settings.rx_variance_m2
    P = np.zeros((n, n))
    P[where.slope, where.slope] = settings.slope_std_m**2
    if dim == 2:
        P[where.height, where.height] = settings.height_std_m**2
    return EstimatorState(
        x=np.zeros(n),
        P=P,
        V=np.zeros((dim, n)),
        information=np.zeros((0, 0)),
        evidence=np.zeros(0),
        anchors=np.zeros(0, ANCHOR_DTYPE),
        packets=np.zeros((0, PACKETS_KEPT), PACKET_DTYPE),
        links=np.zeros((0, 0), LINK_DTYPE),
        status=status,
        settings=settings.record(),
        index_of=np.full(table_size, -1, np.int64),
        h=np.zeros(most_terms(dim)),
        h_index=np.zeros(most_terms(dim), np.uint32),
        ph=np.zeros(n),
        fault_input=np.zeros(dim),
        work=np.zeros((1 + dim, 0)),
    )


def with_anchor(
    s: EstimatorState, table_index: int, position_m: Vector, is_open: bool = False, std_m: float | None = None
) -> EstimatorState:
    """The state with one more anchor, of whose clock and, if it is open, range error nothing is known.

    ``std_m``: of each coordinate of this anchor; None for that of the settings.
    """
    settings, count = s.settings[0], len(s.anchors)
    grown = _selected(s, [*range(count), -1])
    dim, last = int(settings["dim"]), grown.anchors[count]
    last["table_index"], last["position_m"] = table_index, position_m
    last["tx_ticks"] = last["rx_ticks"] = NEVER
    last["held_m"] = np.nan
    last["walk_scale"] = 1.0
    last["change_variance_m2"] = settings["place_std_m"] ** 2
    grown.packets[count] = (NEVER, NEVER, NEVER)
    pair_variance = 0.0
    if settings["range_std_m"] > 0.0 or settings["survey_std_m"] > 0.0 or std_m:
        pair_variance = TUNING.open_pair_std_m**2
    for link in (grown.links[count], grown.links[:, count]):
        link["tx_ticks"], link["variance_m2"] = NEVER, pair_variance
    where = layout(dim, count + 1)
    grown.P[where.change + count, where.change + count] = last["change_variance_m2"]
    range_std_m, survey_std_m = settings["range_std_m"], settings["survey_std_m"] if std_m is None else std_m
    if survey_std_m > 0.0:
        s.status[0]["range_errors"] = ALL_RANGE_ERRORS
    if is_open or s.status[0]["open_range_errors"]:
        s.status[0]["range_errors"] = ALL_RANGE_ERRORS
        range_std_m, survey_std_m = TUNING.late_std_m, TUNING.open_survey_std_m
    grown.P[where.constant + count, where.constant + count] = range_std_m**2
    survey = where.survey + dim * count
    for axis in range(dim):
        grown.P[survey + axis, survey + axis] = survey_std_m**2
    grown.index_of[table_index] = count
    return grown


def without_anchor(s: EstimatorState, anchor: int) -> EstimatorState:
    """The state without one of its anchors."""
    return _selected(s, [index for index in range(len(s.anchors)) if index != anchor])


def with_table(s: EstimatorState, table_size: int) -> EstimatorState:
    """The same state for a longer table of anchors."""
    index_of = np.full(table_size, -1, np.int64)
    index_of[: len(s.index_of)] = s.index_of
    return s._replace(index_of=index_of)


KEPT_ARRAYS: Final = ("x", "P", "V", "information", "evidence", "anchors", "packets", "links", "status")
"""Arrays that a state consists of; the others follow from the settings or are rewritten by each measurement."""


def packed_state(s: EstimatorState) -> dict[str, bytes]:
    """The arrays ``KEPT_ARRAYS`` as bytes."""
    return {name: getattr(s, name).tobytes() for name in KEPT_ARRAYS}


def unpacked_state(settings: EstimatorSettings, table_size: int, arrays: Mapping[str, bytes]) -> EstimatorState:
    """The state whose arrays ``packed_state`` has turned into bytes, which may come from anywhere.

    Kernels check no bounds: all arrays get the shapes that these settings and the number of anchors require, and what
    is an index is checked. Any other numbers will do.

    Raises:
        ValueError: an array is missing or of another size, or an index is out of its range.
    """
    count = len(arrays.get("anchors", b"")) // ANCHOR_DTYPE.itemsize
    if set(arrays) != set(KEPT_ARRAYS) or len(arrays["P"]) != 8 * layout(settings.dim, count).room ** 2:
        raise ValueError("the estimator's arrays are incomplete, or of another number of anchors")
    empty = _selected(new_state(settings, table_size), [-1] * count)
    found = {name: np.frombuffer(arrays[name], getattr(empty, name).dtype) for name in KEPT_ARRAYS}
    s = empty._replace(**{name: array.reshape(getattr(empty, name).shape).copy() for name, array in found.items()})
    table_index = s.anchors["table_index"]
    in_table = len(set(table_index.tolist()) & set(range(table_size))) == count
    if not in_table or not NO_RANGE_ERRORS <= s.status["range_errors"][0] <= ALL_RANGE_ERRORS:
        raise ValueError("an index of the estimator is out of its range")
    s.index_of[table_index] = np.arange(count)
    return s


def _selected(s: EstimatorState, kept: list[int]) -> EstimatorState:
    """The state with these of its anchors, in this order; −1 stands for a new one, all zeros."""
    dim, old, new = int(s.settings[0]["dim"]), len(s.anchors), len(kept)
    was = layout(dim, old)
    states = list(range(dim))
    states += [was.offset + anchor if anchor >= 0 else -1 for anchor in kept]
    states += range(was.velocity, was.velocity + dim)
    for block in (was.rate, was.tx_noise, was.change, was.constant):
        states += [block + anchor if anchor >= 0 else -1 for anchor in kept]
    states += range(was.slope, was.survey)
    for anchor in kept:
        first = was.survey + dim * anchor
        states += [-1] * dim if anchor < 0 else range(first, first + dim)
    states += [-1] * (layout(dim, new).room - len(states))
    faults = [kind * old + anchor if anchor >= 0 else -1 for kind in range(FAULT_KINDS) for anchor in kept]
    n, of_states = len(states), np.array(states)
    of_anchors, of_faults = np.array(kept, np.int64), np.array(faults, np.int64)
    inputs = np.append(of_faults, range(FAULT_KINDS * old, FAULT_KINDS * old + dim))
    index_of = np.full_like(s.index_of, -1)
    result = s._replace(
        x=_select(s.x, of_states),
        P=_select(s.P, of_states, of_states),
        V=_select(s.V, inputs, of_states),
        information=_select(s.information, of_faults, of_faults),
        evidence=_select(s.evidence, of_faults),
        anchors=_select(s.anchors, of_anchors),
        packets=_select(s.packets, of_anchors),
        links=_select(s.links, of_anchors, of_anchors),
        index_of=index_of,
        ph=np.zeros(n),
        fault_input=np.zeros(len(inputs)),
        work=np.zeros((new + 1 + dim, new)),
    )
    there = of_anchors >= 0
    index_of[result.anchors["table_index"][there]] = np.flatnonzero(there)
    return result


def _select(source: NDArray[Scalar], *indices: Integers) -> NDArray[Scalar]:
    """Rows (and columns) of an array; zeros for an index of −1."""
    shape, axes = source.shape, len(indices)
    with_zeros = np.zeros([length + 1 for length in shape[:axes]] + list(shape[axes:]), source.dtype)
    with_zeros[tuple(slice(-1) for _ in indices)] = source  # the last ones, of index −1, are left
    grid = [index.reshape([-1] + [1] * (axes - 1 - axis)) for axis, index in enumerate(indices)]
    return with_zeros[tuple(grid)]
