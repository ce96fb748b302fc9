"""Rooms for studies of surveys, from random errors to results, and the study ``survey-room`` of tags in them.

The air has wrong antenna delays, errors of the pairs of anchors, and the range errors at tags of the scenario ``room``.
The truth of a room does not depend on its site file.

A file's positions are moved to the true frame by the best rigid alignment of all anchors: the direction of the axes is
no error of the site's shape, and tags then walk the same paths for every file.

In ``survey-room`` anchors survey themselves through the air of a room, and the same tags walk there with each file: a
survey's, one by hand, the truth. Two more cases have no errors but noise and a tag at rest in the middle of the lab.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.frame import Malformed, Reception, Transmission
from skyless.core.any_anchor import AnchorMachine, new_anchor
from skyless.core.any_receiver import decode_any
from skyless.core.arrays import Array
from skyless.core.geometry import anchor_positions
from skyless.core.site import EXACT, AccuracySite, AnchorSite, ScheduleSite, Site, TagsSite
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M
from skyless.research.studies.picture import Case, case_row
from skyless.research.studies.runner import Cell, Limit, Plan, Row, of_cases, seed_of, with_limits
from skyless.research.studies.worlds import Run, RunResult, run_world
from skyless.sim.evaluation.scenarios import Room, wanderers
from skyless.sim.impairments import (
    AnchorDisplacement,
    DelayError,
    Impairments,
    PairError,
    RangeErrorModel,
    lab_impairments,
)
from skyless.sim.lab import lab_site
from skyless.sim.trajectory import Static, Trajectory
from skyless.sim.world import World
from skyless.site.channel import ChannelModel
from skyless.site.survey.facts import Facts, PairRanges, Point, Survey, Tape, TapeAdvice
from skyless.site.survey.fit import aligned_covariance
from skyless.site.survey.pair_ranger import PairRanger
from skyless.site.survey.problem import Problem, superimposed
from skyless.site.survey.solve import run_survey
from skyless.site.survey.surveyed_site import surveyed_site

# Sites for studies of surveys.

SLOT_S: Final = 2.5e-3
_ROOM_M: Final = (
    (0.0, 0.0, 0.4),
    (8.0, 0.0, 2.6),
    (8.0, 6.0, 0.4),
    (0.0, 6.0, 2.6),
    (4.0, 0.0, 2.6),
    (8.0, 3.0, 0.4),
    (4.0, 6.0, 2.6),
    (0.0, 3.0, 0.4),
)


class SurveyLayout(Struct, frozen=True, eq=False):
    """Positions of anchors 1 to n."""

    name: str
    dimensions: Literal[2, 3]
    position_m: Array
    """Shape (n, 3)."""
    tag_height_m: float

    @property
    def anchors(self) -> tuple[int, ...]:
        """Identifiers, in the order of the positions."""
        return tuple(range(1, len(self.position_m) + 1))

    @property
    def heights_m(self) -> dict[int, float]:
        """Heights that a survey in two dimensions is given; empty in three."""
        heights = dict(zip(self.anchors, self.position_m[:, 2].tolist(), strict=True))
        return heights if self.dimensions == 2 else {}


def survey_layouts() -> dict[str, SurveyLayout]:
    """``lab``: the reference site. ``room``: 8 m × 6 m in 3-D. ``hall``: 3 × 4 anchors, 12 m apart, at 6 m."""
    lab = np.array([[anchor.x_m, anchor.y_m, 0.0] for anchor in lab_site().anchors])
    room = np.array(_ROOM_M)
    room += np.random.default_rng(7).uniform(-0.3, 0.3, room.shape)
    hall = np.array([(12.0 * column, 12.0 * row, 6.0) for row in range(3) for column in range(4)])
    hall[:, :2] += np.random.default_rng(8).uniform(-1.0, 1.0, (len(hall), 2))
    return {
        "lab": SurveyLayout("lab", 2, lab, 0.0),
        "room": SurveyLayout("room", 3, room, 1.2),
        "hall": SurveyLayout("hall", 2, hall, 1.2),
    }


# Ranges of a site's anchors from simulated air, with real machines.


def stamps_of(site: Site, impairments: Impairments, seconds: float, seed: int, *, settle_s: float = 0.0) -> PairRanger:
    """Ranges of a site from all receptions of its anchors within ``seconds``.

    ``settle_s``: time before the first leg. The last block is closed.
    """
    whole = PairRanger()

    def on_leg(sender: int, receiver: int, tx_ticks: int, rx_ticks: int, t_s: float) -> None:
        if t_s >= settle_s:
            whole.add(sender, receiver, tx_ticks, rx_ticks, t_s)

    world = World(site, lambda one: RecordedAnchor(new_anchor(site, one), site.id, on_leg), (), impairments, seed)
    for _ in world.run(settle_s + seconds):
        pass
    whole.finish()
    return whole


class RecordedAnchor:
    """An anchor whose receptions from its site are passed on as legs."""

    def __init__(
        self, machine: AnchorMachine, site_id: int, on_leg: Callable[[int, int, int, int, float], None]
    ) -> None:
        """``on_leg``: called with sender, receiver, TX and RX ticks, and true time, like ``PairRanger.add``."""
        self._machine, self._site_id, self._on_leg = machine, site_id, on_leg

    @property
    def id(self) -> int:
        """Identifier of the anchor."""
        return self._machine.id

    def hear(self, reception: Reception) -> None:
        """Process one frame, and pass on its leg."""
        self._machine.hear(reception)
        beacon = decode_any(reception.frame)
        if not isinstance(beacon, Malformed) and beacon.site == self._site_id and beacon.anchor != self.id:
            t_s = 0.0 if reception.host_s is None else reception.host_s
            self._on_leg(beacon.anchor, self.id, beacon.tx_ticks, reception.rx_ticks, t_s)

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """The wrapped machine's next transmission."""
        return self._machine.next_transmission_ticks(now_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        """The wrapped machine's transmission."""
        return self._machine.transmission(tx_ticks)


# Rooms with random errors.

HAND_STD_M: Final = 0.02
"""Error of positions measured by hand, per axis."""
SKETCH_STD_M: Final = 0.3
ROOM_RANGES: Final = Room().ranges
"""Errors of ranges at tags in the scenario ``room``."""
TAPE_STD_M: Final = 0.005
LATE_M: Final = (0.2, 1.0)
"""Least and greatest lateness of late pairs."""
_SENSITIVITY_DBM: Final = -105.0
"""Sensitivity at which all anchors receive one another."""
_SETTLE_S: Final = 1.0
"""Time until anchors of protocol 2 send regularly."""


class RoomErrors(Struct, frozen=True):
    """Distribution of the errors of a room."""

    delay_std_m: float = 0.0
    """Standard deviation of h, half of the sum of an anchor's TX and RX delay errors, and of half their difference."""
    pair_std_m: float = 0.0
    """Standard deviation of the constant error of each pair of anchors."""
    ranges: RangeErrorModel = RangeErrorModel()
    """Range errors at tags."""
    late_share: float = 0.0
    missing_share: float = 0.0
    """Shares of all pairs that are late, and that have no ranges."""


class DrawnRoom(Struct, frozen=True, eq=False):
    """A room with its errors. Arrays are in the order of the layout's anchors."""

    layout: SurveyLayout
    tx_delay_m: Array
    """True delay less the usual one, shape (n,)."""
    rx_delay_m: Array
    pairs: tuple[PairError, ...]
    ranges: RangeErrorModel
    hand_m: Array
    """Errors of positions measured by hand, shape (n, 3)."""
    sketch_m: Array
    """Errors of a sketch, shape (n, 3)."""
    tape_m: Array
    """Errors of taped distances."""
    noise_ps: float
    seed: int
    """Seed of the air."""
    late: frozenset[tuple[int, int]] = frozenset()
    missing: frozenset[tuple[int, int]] = frozenset()
    """Pairs that are late, and that have no ranges."""


def free_axes(layout: SurveyLayout) -> Array:
    """Estimated coordinates as 1, the others as 0, shape (3,)."""
    return np.array([1.0, 1.0, 1.0 if layout.dimensions == 3 else 0.0])


def drawn_errors(layout: SurveyLayout, errors: RoomErrors, noise_ps: float, seed: int) -> DrawnRoom:
    """Draw the errors of a room whose TX and RX delays are alike and whose pairs may be late or missing."""
    draw, anchors = np.random.default_rng(seed), layout.anchors
    delay_m = draw.normal(0.0, errors.delay_std_m, len(anchors)) if errors.delay_std_m else np.zeros(len(anchors))
    late, missing, pairs = [], [], []
    for index, a in enumerate(anchors):
        for b in anchors[index + 1 :]:
            error_m = draw.normal(0.0, errors.pair_std_m) if errors.pair_std_m else 0.0
            is_late, is_missing, late_m = draw.random() < errors.late_share, draw.random(), draw.uniform(*LATE_M)
            if is_missing < errors.missing_share:
                missing.append((a, b))
                pairs.append(PairError(a, b, blocked=True))
                continue
            if is_late:
                late.append((a, b))
            if is_late or error_m:
                pairs.append(PairError(a, b, late_m=error_m + (late_m if is_late else 0.0)))
    return DrawnRoom(
        layout=layout,
        tx_delay_m=delay_m,
        rx_delay_m=delay_m,
        pairs=tuple(pairs),
        ranges=errors.ranges,
        seed=int(draw.integers(1 << 60)),
        hand_m=draw.normal(0.0, HAND_STD_M, layout.position_m.shape) * free_axes(layout),
        sketch_m=draw.normal(0.0, SKETCH_STD_M, layout.position_m.shape) * free_axes(layout),
        tape_m=draw.normal(0.0, TAPE_STD_M, 3),
        noise_ps=noise_ps,
        late=frozenset(late),
        missing=frozenset(missing),
    )


def drawn_room(layout: SurveyLayout, errors: RoomErrors, noise_ps: float, seed: int) -> DrawnRoom:
    """Draw the errors of a room without late pairs, whose TX and RX delays differ."""
    draw = np.random.default_rng(seed)
    n, anchors = len(layout.anchors), layout.anchors
    common_m, half_m = errors.delay_std_m * draw.standard_normal((2, n))
    late_m = errors.pair_std_m * draw.standard_normal((n, n))
    return DrawnRoom(
        layout=layout,
        tx_delay_m=common_m + half_m,
        rx_delay_m=common_m - half_m,
        pairs=tuple(
            PairError(anchors[a], anchors[b], late_m=float(late_m[a, b])) for a in range(n) for b in range(a + 1, n)
        ),
        ranges=errors.ranges,
        hand_m=HAND_STD_M * draw.standard_normal((n, 3)) * free_axes(layout),
        sketch_m=SKETCH_STD_M * draw.standard_normal((n, 3)) * free_axes(layout),
        tape_m=TAPE_STD_M * draw.standard_normal(1),
        noise_ps=noise_ps,
        seed=int(draw.integers(1 << 60)),
    )


# A survey compared with the truth: errors after the best rigid alignment, their bound, and errors of a tag.

_GRID: Final = np.linspace(0.15, 0.85, 5)
"""Positions of tags, as shares of the site's length and width."""


class Outcome(Struct, frozen=True):
    """Evaluation of one survey. Lengths are RMS over anchors, after the best rigid alignment."""

    layout: str
    variant: str
    bound_m: float
    """Cramér–Rao bound of the anchors' distance error."""
    is_determined: bool
    """Whether all anchors are determined; otherwise the figures below are None."""
    is_open: bool
    """Whether the survey states that something is not determined, even if only delays against positions."""
    is_flagged: bool
    """Whether the survey states that it is ambiguous, unchecked, or that an anchor is not determined."""
    hand_tag_m: float
    """RMS error of a tag's position with anchor positions measured by hand and unknown delays."""
    error_m: float | None = None
    said_m: float | None = None
    nees: float | None = None
    delay_m: float | None = None
    """Error of the delays relative to their mean."""
    tag_m: float | None = None
    """RMS error of a tag's position with the survey."""
    late: int = 0
    found: int = 0
    """Late pairs that were left out."""
    direct: int = 0
    excluded_wrongly: int = 0


def survey_bound_m(room: DrawnRoom, ranges: PairRanges, facts: Facts, seconds: float) -> float:
    """Bound of the anchors' RMS distance error for the pairs in the air, if it were known which are late."""
    layout, n = room.layout, len(room.layout.position_m)
    if facts.keep_positions:
        return facts.sketch_std_m * math.sqrt(layout.dimensions)
    superframes = seconds / (n * SLOT_S)
    stamp_m2 = (room.noise_ps * 1e-12 * SPEED_OF_LIGHT_MPS) ** 2 + TICK_M**2 / 12.0
    index = {anchor: number for number, anchor in enumerate(layout.anchors)}
    direct = [pair for pair in ranges.pairs if (pair.a, pair.b) not in room.late]
    first, second = (np.array([index[getattr(pair, end)] for pair in direct]) for end in "ab")
    tape_first, tape_second = (np.array([index[getattr(tape, end)] for tape in facts.tapes], int) for end in "ab")
    problem = Problem(
        is_free=np.tile(free_axes(layout) > 0.0, (n, 1)),
        first=first,
        second=second,
        range_m=np.zeros(len(first)),
        variance_m2=np.full(len(first), stamp_m2 / (2.0 * superframes) + facts.pair_std_m**2),
        delay_variance_m2=np.full(n, facts.delay_std_m**2 + stamp_m2 / (4.0 * superframes)),
        coordinate_m=layout.position_m,
        coordinate_variance_m2=np.full((n, 3), facts.sketch_std_m**2 if facts.sketch_m else np.inf),
        tape_first=tape_first,
        tape_second=tape_second,
        tape_m=np.zeros(len(tape_first)),
        tape_variance_m2=np.array([tape.std_m**2 for tape in facts.tapes]),
    )
    covariance = aligned_covariance(problem, layout.position_m, np.ones(n, dtype=bool))
    return math.sqrt(float(np.trace(covariance[: 3 * n, : 3 * n])) / n)


def judged(room: DrawnRoom, survey: Survey, variant: str, bound_m: float, hand_tag_m: float) -> Outcome:
    """A survey compared with the truth of its room; ``bound_m`` and ``hand_tag_m`` as in ``Outcome``."""
    layout = room.layout
    is_determined = all(one.determined for one in survey.anchors) and len(survey.anchors) == len(layout.anchors)
    excluded = {(pair.a, pair.b) for pair in survey.pairs if pair.excluded}
    used = {(pair.a, pair.b) for pair in survey.pairs}
    outcome = Outcome(
        layout=layout.name,
        variant=variant,
        bound_m=bound_m,
        is_determined=is_determined,
        is_open=bool(survey.not_determined),
        is_flagged=bool(survey.ambiguities) or survey.unchecked is not None or not is_determined,
        hand_tag_m=hand_tag_m,
        late=len(room.late),
        found=len(room.late & excluded),
        direct=len(used - room.late),
        excluded_wrongly=len(excluded - room.late),
    )
    if not is_determined:
        return outcome
    found_m = np.array([(one.x_m, one.y_m, one.z_m) for one in survey.anchors], float)
    delay_m = np.array([one.delay_m or 0.0 for one in survey.anchors])
    error_m = found_m - aligned(layout.position_m, found_m, layout.dimensions)
    k = layout.dimensions
    squares = [
        float(error @ np.linalg.pinv(np.array(one.covariance_m2)[:k, :k], rcond=1e-9, hermitian=True) @ error)
        for one, error in zip(survey.anchors, error_m[:, :k], strict=True)
        if one.covariance_m2 is not None
    ]
    off_m = delay_m - room.tx_delay_m
    said_m2 = [k * (one.std_m or 0.0) ** 2 for one in survey.anchors]
    return replace(
        outcome,
        error_m=math.sqrt(float(np.mean(np.sum(error_m**2, axis=1)))),
        said_m=math.sqrt(float(np.mean(said_m2))),
        nees=float(np.mean(squares)) / k if squares else None,
        delay_m=float(np.std(off_m)),
        tag_m=tag_error_m(layout, aligned(found_m, layout.position_m, k), delay_m, room.tx_delay_m),
    )


def aligned(true_m: Array, found_m: Array, axes: int) -> Array:
    """True positions, shape (n, 3), rotated, reflected and shifted to best fit the found ones; in 2-D on the floor."""
    return superimposed(true_m, found_m, np.ones(len(true_m)), slice(axes))


def tag_error_m(layout: SurveyLayout, found_m: Array, delay_m: Array, true_delay_m: Array) -> float:
    """Noise-free RMS error of tags' positions over a grid, due to anchor positions (n, 3) and delays (n,).

    The tag's clock is free; its height is estimated in 3-D.
    """
    low_m, high_m = layout.position_m.min(axis=0), layout.position_m.max(axis=0)
    k, squares = layout.dimensions, []
    for x in _GRID:
        for y in _GRID:
            at_m = low_m + (high_m - low_m) * np.array([x, y, 0.0])
            at_m[2] = layout.tag_height_m
            apart = at_m - layout.position_m
            unit = apart / np.linalg.norm(apart, axis=1)[:, None]
            late_m = np.sum(unit * (found_m - layout.position_m), axis=1) + true_delay_m - delay_m
            design = np.column_stack([unit[:, :k], np.ones(len(unit))])
            squares.append(float(np.sum(np.linalg.lstsq(design, late_m, rcond=None)[0][:k] ** 2)))
    return math.sqrt(float(np.mean(squares)))


# Site files of a room.


def site_at(layout: SurveyLayout, position_m: Array, noise_ps: float) -> Site:
    """A site file with these positions, shape (n, 3), and the usual delays and accuracy."""
    anchors = tuple(
        AnchorSite(anchor, x_m, y_m, z_m)
        for anchor, (x_m, y_m, z_m) in zip(layout.anchors, position_m.tolist(), strict=True)
    )
    tags = TagsSite(layout.tag_height_m if layout.dimensions == 2 else None)
    return replace(lab_site(noise_ps), name=layout.name, anchors=anchors, tags=tags)


def air_of(room: DrawnRoom, site: Site) -> Impairments:
    """Errors of a room's air relative to a site file."""
    stated_m = anchor_positions(site)
    usual = AnchorSite(0, 0.0, 0.0)
    return replace(
        lab_impairments(room.noise_ps),
        delay_errors=tuple(
            DelayError(
                anchor.id,
                float(tx_m) / TICK_M + usual.tx_antenna_delay_ticks - anchor.tx_antenna_delay_ticks,
                float(rx_m) / TICK_M + usual.rx_antenna_delay_ticks - anchor.rx_antenna_delay_ticks,
            )
            for anchor, tx_m, rx_m in zip(site.anchors, room.tx_delay_m, room.rx_delay_m, strict=True)
        ),
        anchor_displacements=tuple(
            AnchorDisplacement(anchor.id, *off_m)
            for anchor, off_m in zip(site.anchors, (room.layout.position_m - stated_m).tolist(), strict=True)
        ),
        anchor_pair_errors=room.pairs,
        range_errors=room.ranges,
    )


def true_site(room: DrawnRoom) -> Site:
    """A site file with the true positions, stated as exact, and delays that make all h 0."""
    site = site_at(room.layout, room.layout.position_m, room.noise_ps)
    delays = zip(site.anchors, room.tx_delay_m, room.rx_delay_m, strict=True)
    anchors = tuple(
        replace(anchor, tx_antenna_delay_ticks=anchor.tx_antenna_delay_ticks + round(float(tx_m + rx_m) / TICK_M))
        for anchor, tx_m, rx_m in delays
    )
    return replace(site, anchors=anchors, accuracy=replace(site.accuracy, survey_std_m=0.0))


def hand_site(room: DrawnRoom) -> Site:
    """A site file with positions measured by hand and the usual delays."""
    return _aligned(room, site_at(room.layout, room.layout.position_m + room.hand_m, room.noise_ps))


def ranges_in_air(room: DrawnRoom, seconds: float) -> PairRanges:
    """Ranges between the anchors, with a site file that has the true positions, where the radio reaches all pairs."""
    # Without a master if pairs are missing: it would have to reach all.
    schedule = ScheduleSite(mode="free") if room.missing else ScheduleSite(slot_s=SLOT_S)
    site = replace(site_at(room.layout, room.layout.position_m, room.noise_ps), schedule=schedule)
    air = replace(air_of(room, site), channel=ChannelModel(sensitivity_dbm=_SENSITIVITY_DBM))
    return stamps_of(site, air, seconds, room.seed, settle_s=_SETTLE_S if room.missing else 0.0).ranges()


def ranges_of(room: DrawnRoom, seconds: float) -> PairRanges:
    """Ranges between the anchors, with a site file from a sketch."""
    site = site_at(room.layout, room.layout.position_m + room.sketch_m, room.noise_ps)
    return stamps_of(site, air_of(room, site), seconds, room.seed).ranges()


def kept_site(room: DrawnRoom, ranges: PairRanges) -> Site:
    """A site file with positions measured by hand, and delays from ``--keep-positions``."""
    rough_m = room.layout.position_m + room.hand_m
    facts = replace(facts_of(room, rough_m), sketch_std_m=HAND_STD_M, keep_positions=True)
    return _aligned(room, _written(room, rough_m, run_survey(ranges, facts), AccuracySite()))


def surveyed_room(room: DrawnRoom, ranges: PairRanges, *, with_tape: bool = False, is_exact: bool = False) -> Site:
    """A site file with positions, delays and accuracy from a survey that started from a sketch.

    ``with_tape``: the distance that the survey advises is measured. ``is_exact``: the survey knows that delays and
    pairs have no errors, and the file states exact ranges.
    """
    rough_m = room.layout.position_m + room.sketch_m
    facts = facts_of(room, rough_m)
    if is_exact:
        facts = replace(facts, delay_std_m=0.0, pair_std_m=0.0)
    survey = run_survey(ranges, facts)
    if with_tape and survey.tapes:
        survey = run_survey(ranges, replace(facts, tapes=taped(room, survey.tapes[:1])))
    return _aligned(room, _written(room, rough_m, survey, EXACT if is_exact else AccuracySite()))


def taped(room: DrawnRoom, advised: Sequence[TapeAdvice]) -> tuple[Tape, ...]:
    """The advised distances as they are measured."""
    at_m = dict(zip(room.layout.anchors, room.layout.position_m, strict=True))
    return tuple(
        Tape(one.a, one.b, float(np.linalg.norm(at_m[one.a] - at_m[one.b])) + float(error_m), TAPE_STD_M)
        for one, error_m in zip(advised, room.tape_m, strict=False)
    )


def facts_of(room: DrawnRoom, rough_m: Array | None) -> Facts:
    """Input of a survey: heights in two dimensions, and a sketch with these positions, shape (n, 3), if any."""
    layout, sketch = room.layout, dict[int, Point]()
    if rough_m is not None:
        sketch = {anchor: (x, y, z) for anchor, (x, y, z) in zip(layout.anchors, rough_m.tolist(), strict=True)}
    return Facts(dimensions=layout.dimensions, heights_m=layout.heights_m, sketch_m=sketch, sketch_std_m=SKETCH_STD_M)


def _written(room: DrawnRoom, rough_m: Array, survey: Survey, accuracy: AccuracySite) -> Site:
    """The site file with a survey written into it; ``accuracy``: as stated before."""
    return surveyed_site(replace(site_at(room.layout, rough_m, room.noise_ps), accuracy=accuracy), survey)


def _aligned(room: DrawnRoom, site: Site) -> Site:
    """The site with its positions moved to the frame of the truth."""
    moved_m = aligned(anchor_positions(site), room.layout.position_m, room.layout.dimensions)
    anchors = tuple(
        replace(anchor, x_m=x_m, y_m=y_m, z_m=z_m)
        for anchor, (x_m, y_m, z_m) in zip(site.anchors, moved_m.tolist(), strict=True)
    )
    return replace(site, anchors=anchors)


TRUTH: Final = "truth"
SURVEYED: Final = "surveyed"
TAPED: Final = "surveyed, a tape"
KEPT: Final = "positions kept"
HAND: Final = "by hand"

_WARMUP_S: Final = 1.5
_SURVEY_S: Final = 20.0
_DELAY_STD_M: Final = 0.07
_RUN_S: Final = 0.018
"""Approximate CPU time of a tag for a second of a world."""


class Group(Struct, frozen=True):
    """Rooms of one kind."""

    name: str
    layout: str
    errors: RoomErrors = RoomErrors()
    files: tuple[str, ...] = (TRUTH, SURVEYED)
    """The first one is the reference for the others."""
    at_rest: bool = False
    """Tags at rest, delays known and no errors but noise; the survey knows that."""


def groups() -> tuple[Group, ...]:
    """The lab and the room in 3-D, with errors of pairs from none on; then tags at rest in the lab."""
    of_layout = {"lab": (TRUTH, SURVEYED, TAPED, KEPT, HAND), "room": (TRUTH, SURVEYED, KEPT, HAND)}
    walking = [
        Group(
            f"{layout}, pairs {100.0 * pair_std_m:g} cm",
            layout,
            RoomErrors(_DELAY_STD_M, pair_std_m, ROOM_RANGES),
            files,
        )
        for layout, files in of_layout.items()
        for pair_std_m in (0.0, 0.02, 0.05)
    ]
    return (*walking, Group("lab, at rest", "lab", at_rest=True))


def limits_of(group: Group, file: str) -> tuple[Limit, ...]:
    """Limits: within 1.2 times what surveyed truth gives in the room, 5 % at rest; honest fixes and levels."""
    if file in {TRUTH, HAND}:
        return ()
    if group.at_rest:
        return (Limit("ratio", most=1.05),)
    honest = (Limit("nees", most=1.3), Limit("level", 0.99), Limit("exceeded", most=1e-4))
    is_room = group.errors.pair_std_m == 0.0  # of the scenario room
    return (Limit("ratio", most=1.2), *honest) if is_room else honest


def cells(plan: Plan) -> list[Cell]:
    """One cell for each world."""
    survey_s, tags_s = _survey_s(plan) * 0.06, plan.tags * (plan.seconds + _WARMUP_S) * _RUN_S
    return [
        Cell(group.name, partial(room_results, plan, group, world), survey_s + len(group.files) * tags_s)
        for group in groups()
        for world in range(plan.worlds)
    ]


def _survey_s(plan: Plan) -> float:
    """How long anchors survey themselves."""
    return min(_SURVEY_S, 2.0 * plan.seconds)


def room_results(plan: Plan, group: Group, world: int) -> tuple[RunResult, ...]:
    """Results of the tags with each file of a room."""
    seed = seed_of(plan.seed, world)
    room = drawn_room(survey_layouts()[group.layout], group.errors, plan.noise_ps, seed)
    if group.at_rest:
        paths: tuple[Trajectory, ...] = (Static(3.0, 4.0, 0.0),) * plan.tags
    else:
        paths = tuple(wanderers(site_at(room.layout, room.layout.position_m, plan.noise_ps), plan.tags, room.seed))
    return tuple(
        run_world(
            Run(
                site=site,
                trajectories=paths,
                impairments=air_of(room, site),
                seed=room.seed,
                method=plan.method,
                warmup_s=_WARMUP_S,
                until_s=_WARMUP_S + plan.seconds,
            )
        )
        for site in _files(plan, group, room)
    )


def _files(plan: Plan, group: Group, room: DrawnRoom) -> list[Site]:
    ranges = ranges_of(room, _survey_s(plan))
    if group.at_rest:
        return [replace(true_site(room), accuracy=EXACT), surveyed_room(room, ranges, is_exact=True)]
    made = {
        TRUTH: lambda: true_site(room),
        SURVEYED: lambda: surveyed_room(room, ranges),
        TAPED: lambda: surveyed_room(room, ranges, with_tape=True),
        KEPT: lambda: kept_site(room, ranges),
        HAND: lambda: hand_site(room),
    }
    return [made[file]() for file in group.files]


def rows(plan: Plan, results: Sequence[Any]) -> Sequence[Row]:
    """A row for each group and file; the ratio is that to the truth's RMSE in the same worlds."""
    found = []
    for group, worlds in of_cases(groups(), results):
        truth = [world[0] for world in worlds]
        for column, file in enumerate(group.files):
            own = [world[column] for world in worlds]
            limits = () if plan.quick else limits_of(group, file)
            case = Case(f"{group.name}, {file}", group.name, None, (), of=None if file == TRUTH else TRUTH)
            row = case_row("survey-room", plan, case, own, None if file == TRUTH else truth)
            found.append(with_limits(row, limits))
    return found
