"""Named and numbered simulations: from a user's request to a fleet in a world."""

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import ArrayLike

from skyless.arguments import TagCount
from skyless.core.arrays import Array
from skyless.core.errors import SkylessError
from skyless.core.geometry import rectangle_of
from skyless.core.method_names import DEFAULT_METHOD, FILTERS, SNAPSHOTS
from skyless.core.site import FloorSite, Site
from skyless.sim.evaluation.fleet import AnyFleet, Fleet, FleetSettings, JudgedFix, TagReceiver, TapeFleet
from skyless.sim.evaluation.request import Conditions
from skyless.sim.impairments import AnchorDisplacement, Body, CarrierModel, Impairments, RangeErrorModel, WarmUp
from skyless.sim.motion_sensor import MotionErrors
from skyless.sim.oscillator import OscillatorModel, Temperature
from skyless.sim.streams import stream
from skyless.sim.trajectory import Roaming, Static, Trajectory, Waypoints
from skyless.site.channel import ChannelModel

WALL_MARGIN_M: Final = 0.5
"""Walking tags keep this distance from the box around the anchors."""

CARRIED_M: Final = 1.1
"""Height above the ground at which tags walk on a floor."""

MIN_WALK_M: Final = 1.0
"""Walking tags have at least this much space along x and y, even around a single anchor."""

WAYPOINTS: Final = 8

MAX_MACHINES: Final = 200
"""Sites of protocol 2 with more anchors are tapes."""

COMFORT_MPS2: Final = 2.0
"""Acceleration with which people and robots turn."""

ROOM_QA_M2PS3: Final = 0.3
"""Density of the random accelerations of tags in a room."""

_BOX_SIGMAS: Final = 3.0
"""Standard deviations from the middle of the box in which tags wander to its walls."""

# Keys of streams of random numbers, in addition to those of the simulated world.
_ROOM_KEY: Final = 4
_ROAM_KEY: Final = 6


class Room(Struct, frozen=True):
    """Errors of a real room in addition to noise: survey and ranges, drawn from a world's seed.

    The sizes are those that recordings of DW1000s show after a survey and a calibration by hand (``docs/studies.md``).
    """

    axis_std_m: float = 0.02
    """Standard deviation of each stated anchor coordinate; of the height only where it is used."""
    off_anchors: int = 0
    """Number of anchors, drawn by chance, that are off by ``off_m`` more, each in a random horizontal direction."""
    off_m: float = 0.0
    ranges: RangeErrorModel = RangeErrorModel(constant_m=0.05, slope_m=0.05)
    """Errors of the ranges at tags."""
    is_stated: bool = False
    """Whether these are the errors that the site's file states: anchors with their own ``std_m`` have that, and tags
    without a given motion walk as in exact air; otherwise they accelerate at random."""


class Request(Conditions, frozen=True):
    """A simulation: a site, the options of ``skyless simulate``, and options for programs only."""

    site: Site
    room: Room | None = None
    """Errors of survey and ranges (``room_of``); None for anchors at the site's positions and exact ranges."""
    new_receiver: Callable[[], TagReceiver] | None = None
    """Creates each tag's receiver, instead of one of the method."""
    diagnostics: bool = False
    """Whether receptions include powers; the first path's is low if they are late."""
    body: Body | None = None
    warm_ups: tuple[WarmUp, ...] = ()
    walls_between_anchors: bool = True


def stated_room(site: Site, *, slope_m: float, at_rest: bool) -> Room:
    """Errors of survey and ranges as large as the site's file states them.

    Multipath changes with time for tags at rest, otherwise with the distance moved.
    """
    accuracy = site.accuracy
    ranges = RangeErrorModel(
        constant_m=math.sqrt(3.0) * accuracy.range_std_m,
        slope_m=slope_m,
        changing_m=accuracy.place_std_m,
        correlation_s=accuracy.place_time_s if at_rest else None,
        correlation_m=None if at_rest else accuracy.place_distance_m,
    )
    return Room(axis_std_m=accuracy.survey_std_m, ranges=ranges, is_stated=True)


def room_of(site: Site, seed: int, *, is_named_room: bool, at_rest: bool) -> Room | None:
    """Errors of a simulation: the named room's, otherwise what the site states; None if there are none."""
    if is_named_room:
        return Room()
    if site.accuracy.is_exact and not any(anchor.std_m for anchor in site.anchors):
        return None
    slope_m = site.accuracy.slope_std_m * float(stream(seed, _ROOM_KEY, 1).standard_normal())
    return stated_room(site, slope_m=slope_m, at_rest=at_rest)


def errors_words(site: Site, room: Room | None) -> str:
    """Description of the errors that a simulation draws, for display."""
    if room is None:
        return "none: positions and ranges are exact"
    if not room.is_stated:
        ranges = f"ranges up to {100.0 * room.ranges.constant_m:g} cm and a slope"
        return f"positions {100.0 * room.axis_std_m:g} cm (σ), {ranges}"
    stated = site.accuracy
    of_anchors = position_stds_m(site)
    stds_m = {
        "positions": sorted({min(of_anchors), max(of_anchors)}),
        "ranges": [stated.range_std_m],
        "slope": [stated.slope_std_m],
        "multipath": [stated.place_std_m],
    }
    each = (f"{what} {' to '.join(f'{100.0 * one:.3g}' for one in found)}" for what, found in stds_m.items())
    return f"as the site states (σ in cm): {', '.join(each)}"


def position_stds_m(site: Site) -> list[float]:
    """Standard deviation of each anchor's position, per axis."""
    return [site.accuracy.survey_std_m if anchor.std_m is None else anchor.std_m for anchor in site.anchors]


def check_can_be_simulated(site: Site, method: str = DEFAULT_METHOD) -> None:
    """Check that tags of the site can have fixes by the method. Raises SkylessError."""
    if not site.schedule.needs_master and method in SNAPSHOTS:
        raise SkylessError(
            f"--method is {method!r}, which needs a master, and site {site.name!r} has none (mode "
            f"{site.schedule.mode}); it should be {' or '.join(FILTERS)}"
        )
    if not site.anchors:
        raise SkylessError(f"no anchor of site {site.name!r} has a position, so it cannot be simulated")


def fleet_of(request: Request) -> Fleet:
    """Create the world and its tags; the anchors are the machines that would run on radios.

    Raises:
        SkylessError: tags of the site can have no fixes by the method.
        ValueError: an anchor that is to fail does not exist.
    """
    site = request.site
    check_can_be_simulated(site, request.method)
    if request.noise_ps is not None:
        noise = replace(site.noise, tx_stamp_ps=request.noise_ps, rx_stamp_ps=request.noise_ps)
        site = replace(site, noise=noise)
    return Fleet(site, trajectories_of(request), impairments_of(request, site), request.seed, _settings(request))


def fleet_of_any_size(request: Request) -> AnyFleet:
    """Like ``fleet_of``, but the anchors of a large site of protocol 2 are a tape.

    Raises:
        ValueError: as ``fleet_of``, or a requested fault is not modelled at such a site.
    """
    site, room = request.site, request.room
    if site.schedule.needs_master or len(site.anchors) <= MAX_MACHINES:
        return fleet_of(request)
    faults = impairments_of(request, site)
    unfit = {
        "--outage": request.outages,
        "--bias": request.biases,
        "--delay-error": request.delay_errors,
        "--silence": request.silences,
        "--nlos": request.nlos,
        "--temperature": request.temperature,
        "--carrier": request.carrier,
        "--carries": request.carries,
        "walls of the site file": site.walls,
        "floors of the site file": site.storeys[1:],
    }
    for name, given in unfit.items():
        if given:
            raise ValueError(f"{name}: not modelled at a site of more than {MAX_MACHINES} anchors")
    return TapeFleet(
        site,
        trajectories_of(request),
        replace(faults, anchor_displacements=()),
        request.seed,
        _settings(request),
        survey_std_m=0.0 if room is None else float(np.sqrt(np.mean(np.square(_axis_stds_m(room, site))))),
    )


def _settings(request: Request) -> FleetSettings:
    return FleetSettings(
        request.method,
        request.settle_s,
        request.fixes,
        request.requirement(request.method),
        tuple(request.silences),
        None if request.carries is None else MotionErrors(has_wheels=request.carries == "wheels"),
        request.new_receiver,
    )


def impairments_of(request: Request, site: Site) -> Impairments:
    """Noise and faults: the site's noise figures are the true ones."""
    noise, room = site.noise, request.room
    return Impairments(
        tx_stamp_ps=noise.tx_stamp_ps,
        rx_stamp_ps=noise.rx_stamp_ps,
        oscillator=OscillatorModel(
            white_fm=noise.white_fm,
            random_walk_fm=noise.random_walk_fm,
            temperature=Temperature() if request.temperature else None,
        ),
        channel=ChannelModel(
            loss_probability=request.loss,
            nlos_probability=request.nlos,
            nlos_mean_m=request.nlos_mean_m,
            walls_between_anchors=request.walls_between_anchors,
        ),
        anchor_biases=tuple(request.biases),
        delay_errors=tuple(request.delay_errors),
        anchor_outages=tuple(request.outages),
        anchor_displacements=() if room is None else displacements(room, site, request.seed),
        range_errors=RangeErrorModel() if room is None else room.ranges,
        body=request.body,
        warm_ups=request.warm_ups,
        carrier=CarrierModel() if request.carrier else None,
        diagnostics=request.diagnostics,
    )


def trajectories_of(request: Request) -> list[Trajectory]:
    """Tags at the given positions and on the given paths, otherwise walking inside the box around the anchors.

    Those of a room wander with random acceleration.
    """
    height_m = request.site.tags.height_m or 0.0
    given: list[Trajectory] = [Static(*_with_height(point, height_m)) for point in request.positions_m]
    for path in request.paths_m:
        points = [_with_height(point, height_m) for point in path]
        is_closed = len(points) > 2 and points[0] == points[-1]
        given.append(_smooth_path(points[:-1] if is_closed else points, request.speed_mps or 1.0, loop=is_closed))
    if given or request.room is None or request.room.is_stated:
        return given or [_walk(request, index) for index in range(request.tags or 1)]
    return wanderers(request.site, request.tags or 1, request.seed)


def wanderers(site: Site, tags: int, seed: int) -> list[Trajectory]:
    """Tags that wander with random acceleration inside the box around the anchors."""
    low, high = _walkable_box(site)
    return [wanderer(low, high, seed, tag) for tag in range(tags)]


def displacements(room: Room, site: Site, seed: int) -> tuple[AnchorDisplacement, ...]:
    """True minus stated positions of the anchors; the first draws are the same for all rooms of a seed."""
    draw = stream(seed, _ROOM_KEY, 0)
    count = len(site.anchors)
    shifts_m = _axis_stds_m(room, site)[:, None] * draw.standard_normal((count, 3))
    if site.tags.height_m is not None:
        shifts_m[:, 2] = 0.0
    off, directions = draw.permutation(count)[: room.off_anchors], draw.uniform(0.0, 2.0 * math.pi, count)
    shifts_m[off, 0] += room.off_m * np.cos(directions[off])
    shifts_m[off, 1] += room.off_m * np.sin(directions[off])
    return tuple(
        AnchorDisplacement(anchor.id, *shift) for anchor, shift in zip(site.anchors, shifts_m.tolist(), strict=True)
    )


def _axis_stds_m(room: Room, site: Site) -> Array:
    """Standard deviations of the anchors' positions per axis, shape (anchors,)."""
    return np.array(position_stds_m(site) if room.is_stated else [room.axis_std_m] * len(site.anchors))


def wanderer(low_m: Array, high_m: Array, seed: int, tag: int, qa_m2ps3: float = ROOM_QA_M2PS3) -> Roaming:
    """A tag with random acceleration that is inside the box for 99.7 % of the time along each axis."""
    own = int(stream(seed, _ROAM_KEY, tag).integers(2**62))
    return Roaming((low_m + high_m) / 2.0, (high_m - low_m) / (2.0 * _BOX_SIGMAS), qa_m2ps3=qa_m2ps3, seed=own)


def _with_height(point: Sequence[float], height_m: float) -> tuple[float, float, float]:
    return point[0], point[1], point[2] if len(point) > 2 else height_m


def _walk(request: Request, index: int) -> Trajectory:
    """Walk in a loop between random points inside the box, turning gently at each."""
    low, high = _walkable_box(request.site, walked_floor(request.site, request.tags or 1, index))
    generator = np.random.default_rng([request.seed, index])
    points, shortest_m = [generator.uniform(low, high)], np.linalg.norm(high - low) / 4.0
    while len(points) < WAYPOINTS:
        point = generator.uniform(low, high)
        neighbours = [points[-1], points[0]] if len(points) == WAYPOINTS - 1 else [points[-1]]
        if all(np.linalg.norm(point - other) > shortest_m for other in neighbours):
            points.append(point)
    return _smooth_path(points, request.speed_mps or 1.0)


def _smooth_path(points: Sequence[ArrayLike], speed_mps: float, *, loop: bool = True) -> Waypoints:
    """Path with corners as gentle as the legs allow, at most ``COMFORT_MPS2``; ``loop``: round and round."""
    points_m = np.array(points, dtype=np.float64)
    steps_m = np.roll(points_m, -1, axis=0) - points_m
    legs_m = np.linalg.norm(steps_m if loop else steps_m[:-1], axis=1)
    corner_s = min(2.0 * speed_mps / COMFORT_MPS2, 0.9 * float(legs_m.min()) / speed_mps)
    return Waypoints(points_m, speed_mps, loop=loop, corner_s=corner_s)


def walked_floor(site: Site, tags: int, index: int) -> FloorSite | None:
    """The floor of a tag: the one named by a ``TagCount``, otherwise each in turn; None for a site without floors.

    Raises SkylessError: the site has no such floor.
    """
    named, floors = tags.floor if isinstance(tags, TagCount) else None, site.storeys
    if site.tags.height_m is not None:  # all tags are at one height
        floors = ()
    if named is None:
        return floors[index % len(floors)] if floors else None
    for floor in floors:
        if floor.number == named:
            return floor
    there = ", ".join(str(floor.number) for floor in floors)
    there = there or "none: it has no [[floors]], or the height of all tags is given"
    raise SkylessError(f"--tags is '{int(tags)}@{named}'; the floor should be one of the site's: {there}")


def _walkable_box(site: Site, floor: FloorSite | None = None) -> tuple[Array, Array]:
    """Box in which tags walk: among the anchors; on a floor, among its own at the height at which tags are carried."""
    own = [anchor for anchor in site.anchors if floor is not None and anchor.floor == floor.number] or site.anchors
    points_m = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in own])
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    room = rectangle_of(site)  # in a room of another shape the box around it would be partly outside
    if room is not None:
        low[:2], high[:2] = room[:2], room[2:]
    margin = np.minimum(WALL_MARGIN_M, (high - low) / 4.0)
    lacking = np.maximum((MIN_WALK_M, MIN_WALK_M, 0.0) - (high - low - 2.0 * margin), 0.0) / 2.0
    low, high = low + margin - lacking, high - margin + lacking
    if site.tags.height_m is not None:
        low[2] = high[2] = site.tags.height_m
    elif floor is not None:
        low[2] = high[2] = floor.low_m + CARRIED_M
    return low, high


def patrols(site: Site, tags: int, speed_mps: float = 1.0) -> list[Trajectory]:
    """Tags walking round the site one behind the other, each on a narrower path, as in the demo."""
    paths: list[Trajectory] = []
    for index in range(tags):
        low, high = _walkable_box(site, walked_floor(site, tags, index))
        inset = (high - low)[:2] * 0.12 * (index % 3)
        x0, y0 = low[:2] + inset
        x1, y1 = high[:2] - inset
        z = float((low[2] + high[2]) / 2.0)
        corners = [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]
        paths.append(_smooth_path(corners[index % 4 :] + corners[: index % 4], speed_mps))
    return paths


# Runs to their end

_LONGEST_WAIT_S: Final = 60.0
"""Simulated time for which a run whose goal is fixes waits for one."""


def run_fleet(
    fleet: AnyFleet,
    request: Request,
    until_s: float,
    on_fix: Callable[[JudgedFix], None] | None,
    on_progress: Callable[[float], None],
) -> None:
    """Run the world in steps; ``on_fix`` gets every fix, ``on_progress`` the share done from time to time."""
    fixes, now_s = request.fixes, 0.0
    while now_s < until_s and not _is_enough(fleet, request, now_s):
        now_s = min(now_s + fleet.step_s, until_s)
        for judged in fleet.run(now_s):
            if on_fix is not None:
                on_fix(judged)
        on_progress(now_s / until_s if fixes is None else fleet.errors.count / len(fleet.records) / fixes)


def _is_enough(fleet: AnyFleet, request: Request, now_s: float) -> bool:
    """Whether all tags have their fixes, or the others have waited too long with no planned return."""
    fixes = request.fixes
    if fixes is None:
        return False
    returns_s = [planned.outage.on_s for planned in request.outages] + [silence.on_s for silence in request.silences]
    planned_s = max(filter(math.isfinite, returns_s), default=0.0)
    last_s = (0.0 if tag.last is None else tag.last.time_s for tag in fleet.records if tag.judged < fixes)
    return all(now_s - max(tag_s, planned_s) > _LONGEST_WAIT_S for tag_s in last_s)
