"""Template sites, and their files with a comment on every key."""

import json
from itertools import product
from typing import Final

from msgspec import UNSET, structs

from skyless.core.site import (
    AlarmRule,
    AnchorSite,
    FloorPlanSite,
    FloorSite,
    GeoreferenceSite,
    Outline,
    ScheduleSite,
    Site,
    TagsSite,
    UnplacedAnchor,
)
from skyless.site.file.check import ANY_ADDRESS

_HEAD = """\
# A Skyless site. Lengths are metres in the site's own frame: x and y on the floor, z up.
# `skyless site check FILE` checks it.

name = {name}
id = {id}                          # of the site on the air, 0 to 65533; neighbouring sites need different ones
{master}# The room: its corners in order, [x, y] each; for the map, planning and simulation.
{no_outline}outline_m = {outline}

{schedule}
[noise]                         # what the filters assume; too small costs more than too large
tx_stamp_ps = {tx_ps}             # standard deviation of a transmit stamp in picoseconds
rx_stamp_ps = {rx_ps}             # of a receive stamp; a DW1000 has 100 to 150
white_fm = {white}                # crystals' white frequency noise: Allan deviation at 1 s
random_walk_fm = {walk}          # crystals' random-walk frequency noise in 1/√s

# Errors that do not average out, as standard deviations; 0 means exact. Too small: tags report
# standard deviations that are too small. Too large: the fixes are less accurate.
[accuracy]
survey_std_m = {survey_std_m}             # how well each anchor's position was measured, in each of x, y and z
range_std_m = {range_std_m}              # constant error of the distances to an anchor, a different one for each anchor
slope_std_m = {slope_std_m}              # error that grows with the distance: none at 4 m, this much from 8 m on
place_std_m = {place_std_m}              # error of the distances that changes as a tag moves (reflections)
place_distance_m = {place_distance_m}          # how far a tag moves until that error is a different one
place_time_s = {place_time_s}            # after how many seconds it is a different one while the tag is at rest
"""

_MASTER = """\
master = {master}                      # its clock is the site's time; best in the middle, in range of all
"""

_FREE_SCHEDULE = """\
[schedule]                      # who sends when
mode = "free"                   # anchors send at random instants; "master" is the paper's protocol, with slots
{no_rate}rate_hz = {rate_hz}                # beacons per second of each anchor; as many as fit by default
{no_phase}carrier_phase = {phase}          # anchors relay phases of the carrier, too; older tags drop such beacons
"""

_MASTER_SCHEDULE = """\
[schedule]                      # who sends when
mode = "master"                 # the paper's protocol: all anchors hear one master and send in turn, in slots
slot_s = {slot_s}                 # length of a slot in seconds; all slots make a superframe
guard_s = {guard_s}                # silence at the end of each slot, to prepare a frame
frames_per_node = {frames}             # frames of each anchor in a superframe
{no_slots}slots = {slots}                     # slots in a superframe; by default one for each frame
"""

_KNOWN_HEIGHT = """
[tags]
height_m = {height}                  # all tags move at this height (2-D); leave the key out to estimate the height
"""

_ESTIMATED_HEIGHT = """
[tags]
# height_m = 1.2                # for tags that all move at one height (2-D); without it the height is estimated
"""

_ANCHORS = """
# The anchors: positions of the antennas. Optional keys, with their defaults:
#   tx_antenna_delay_ticks = 16436   antenna delays in ticks of 15.65 ps
#   rx_antenna_delay_ticks = 16436
{more}"""

_MASTER_ANCHORS = """\
#   slot = 0                         first slot; otherwise the master sends first, the others as listed
"""

_FREE_ANCHORS = """\
#   floor = 0                        storey
#   zone = 0                         zone of the site, 0 to 255; 0 for none
#   std_m = 0.02                     how well its position is known; by default survey_std_m
# An anchor may be listed without x_m, y_m and z_m: it then sends and relays, and tags do not use it.
"""

_ANCHOR = """
[[anchors]]
id = {id}
x_m = {x}
y_m = {y}
z_m = {z}
"""

_UNPLACED = """
[[anchors]]
id = {id}
"""

_SLOT = "slot = {slot}\n"

_NO_WALLS = """
# Walls, full height, for planning and simulation; one table for each.
# [[walls]]
# x1_m = 2.0
# y1_m = 0.0
# x2_m = 2.0
# y2_m = 3.5
# loss_db = 6.0                 # what a signal loses on its way through
# delay_m = 0.1                 # by how much it comes late, as a length
"""

_WALLS = """
# Walls, full height, for planning and simulation: what a signal loses on its way through, and how late it comes.
"""

_WALL = """
[[walls]]
x1_m = {x1_m}
y1_m = {y1_m}
x2_m = {x2_m}
y2_m = {y2_m}
loss_db = {loss_db}
delay_m = {delay_m}
"""

_ALARMS = """
# Rules that raise alarms; one table for each (docs/howto/alarms.md).
{rules}"""

_EXAMPLE_RULE = AlarmRule("silent", "silent", after_s=60.0)

_FLOOR_PLAN = """
# An image of the floor behind the map.
{off}[floor_plan]
{off}image = {image}           # PNG or JPEG, relative to this file
{off}width_m = {width_m}                 # what the image's width measures on the floor
{off}x_m = {x_m}                     # position of its lower left corner
{off}y_m = {y_m}
"""

_FLOORS = """
# Several floors, the lowest first: a tag is on the one that its height says.
"""

_FLOOR = """\
{off}[[floors]]
{off}number = {number}                    # that of its anchors
{off}low_m = {low_m}                   # height of its ground
{off}name = {name}
{no_loss}slab_loss_db = {slab_loss_db}          # of a signal that crosses its ground, in simulations and plans
{no_delay}slab_delay_m = {slab_delay_m}
{off}image = {image}         # a plan of its own, as of [floor_plan]
{off}width_m = {width_m}
{off}x_m = {x_m}
{off}y_m = {y_m}
"""

_GEOREFERENCE = """
# Position of the site's origin on the Earth (WGS 84).
{off}[georeference]
{off}latitude_deg = {latitude_deg}
{off}longitude_deg = {longitude_deg}
{off}height_m = {height_m}
{off}heading_deg = {heading_deg}             # azimuth of the y axis, clockwise from true north
"""

_EXAMPLE_OUTLINE: Final = ((0.0, 0.0), (12.0, 0.0), (12.0, 8.0), (0.0, 8.0))
_EXAMPLE_RATE_HZ: Final = 30.0
_EXAMPLE_PLAN = FloorPlanSite(image="floor.png", width_m=6.0)
_EXAMPLE_FLOOR = FloorSite(number=1, low_m=3.2, name="Upper floor", image="upper.png", width_m=6.0)
_EXAMPLE_GEOREFERENCE = GeoreferenceSite(latitude_deg=47.3769, longitude_deg=8.5417, height_m=408.0)

_FROM_FLOOR_AND_CEILING_M: Final = 0.5
_FARTHEST_M: Final = 8388.0  # largest coordinate that an anchor can state


def site_template(site: Site, schedule_comment: str = "") -> str:
    """Site file with a comment on every key of its mode, and one above the schedule; of anchors only position and slot.

    Walls, floor plan and georeference that the site lacks are commented examples.
    """
    schedule, noise = site.schedule, site.noise
    head = _HEAD.format(
        name=json.dumps(site.name, ensure_ascii=False),
        id=site.id,
        master=_MASTER.format(master=site.master) if schedule.needs_master else "",
        schedule=schedule_comment + _schedule(site),
        outline=[list(corner) for corner in (_EXAMPLE_OUTLINE if site.outline_m is UNSET else site.outline_m)],
        no_outline=_off(site.outline_m is not UNSET),
        tx_ps=noise.tx_stamp_ps,
        rx_ps=noise.rx_stamp_ps,
        white=noise.white_fm,
        walk=noise.random_walk_fm,
        **structs.asdict(site.accuracy),
    )
    height = site.tags.height_m
    tags = _ESTIMATED_HEIGHT if height is None else _KNOWN_HEIGHT.format(height=height)
    tags += _silences(site.tags)
    anchors = _ANCHORS.format(more=_MASTER_ANCHORS if schedule.needs_master else _FREE_ANCHORS)
    return head + tags + anchors + "".join(map(_anchor, site.all_anchors)) + _tail(site)


def _schedule(site: Site) -> str:
    schedule = site.schedule
    if not schedule.needs_master:
        return _FREE_SCHEDULE.format(
            rate_hz=schedule.rate_hz or _EXAMPLE_RATE_HZ,
            no_rate=_off(schedule.rate_hz is not None),
            phase="false" if schedule.carrier_phase is False else "true",
            no_phase=_off(schedule.carrier_phase is not UNSET),
        )
    return _MASTER_SCHEDULE.format(
        slot_s=schedule.slot_s,
        guard_s=schedule.guard_s,
        frames=schedule.frames_per_node,
        slots=schedule.slots or len(site.all_anchors) * schedule.frames_per_node,
        no_slots=_off(schedule.slots is not None),
    )


def _off(given: bool) -> str:
    return "" if given else "# "


def _anchor(anchor: AnchorSite | UnplacedAnchor) -> str:
    slot = "" if anchor.slot is None else _SLOT.format(slot=anchor.slot)
    if isinstance(anchor, UnplacedAnchor):
        return _UNPLACED.format(id=anchor.id) + slot
    return _ANCHOR.format(id=anchor.id, x=anchor.x_m, y=anchor.y_m, z=anchor.z_m) + slot


def _tail(site: Site) -> str:
    walls = "".join(_WALL.format(**structs.asdict(wall)) for wall in site.walls)
    plan, earth = site.floor_plan or _EXAMPLE_PLAN, site.georeference or _EXAMPLE_GEOREFERENCE
    floors, image = site.storeys or (_EXAMPLE_FLOOR,), json.dumps(plan.image, ensure_ascii=False)
    return (
        (_WALLS + walls if walls else _NO_WALLS)
        + _ALARMS.format(rules="\n".join(map(_rule, site.alarms)) if site.alarms else _rule(_EXAMPLE_RULE, "# "))
        + _FLOOR_PLAN.format(**{**structs.asdict(plan), "image": image}, off=_off(site.floor_plan is not None))
        + _FLOORS
        + "".join(_floor(floor, _off(bool(site.storeys))) for floor in floors)
        + _GEOREFERENCE.format(**structs.asdict(earth), off=_off(site.georeference is not None))
    )


def _floor(floor: FloorSite, off: str) -> str:
    """The table of a floor; without an image it lacks the image's keys."""
    texts = {key: json.dumps(getattr(floor, key), ensure_ascii=False) for key in ("name", "image")}
    loss_db, delay_m = floor.slab
    slab = {"slab_loss_db": loss_db, "slab_delay_m": delay_m}
    no_loss, no_delay = (_off(getattr(floor, key) is not UNSET) for key in slab)
    table = _FLOOR.format(**{**structs.asdict(floor), **texts, **slab}, off=off, no_loss=no_loss, no_delay=no_delay)
    return table if floor.image is not None else "".join(table.splitlines(keepends=True)[:6])


def _rule(rule: AlarmRule, off: str = "") -> str:
    """The table of an alarm rule, with the keys that differ from their defaults."""
    values = {key: value for key, value in structs.asdict(rule).items() if value not in (None, "", ())}
    usual = {field.name: field.default for field in structs.fields(AlarmRule)}
    lines = [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in values.items() if value != usual[key]]
    return "".join(f"{off}{line}\n" for line in ("[[alarms]]", *lines))


def rectangle(width_m: float, depth_m: float) -> Outline:
    """Outline of a rectangular room with a corner at (0, 0)."""
    return (0.0, 0.0), (width_m, 0.0), (width_m, depth_m), (0.0, depth_m)


def _silences(tags: TagsSite) -> str:
    """After which silence tags have gone, where the site says so."""
    longest_s, groups = tags.longest_silence_s, tags.group_silence_s or {}
    named = ", ".join(f"{json.dumps(name, ensure_ascii=False)} = {seconds}" for name, seconds in groups.items())
    return (
        f"{_off(longest_s is not UNSET)}longest_silence_s = {900.0 if longest_s is UNSET else longest_s}"
        "       # a tag that is silent for longer has gone, however rarely it sends\n"
        f"{_off(bool(named))}group_silence_s = {{{named or 'vehicles = 60.0'}}}   # the same for groups of assets\n"
    )


def rectangular_site(width_m: float, depth_m: float, anchors: int, height_m: float, tag_height_m: float | None) -> Site:
    """A rectangular room with anchors evenly spaced along its walls, starting at the corner (0, 0).

    Anchors alternate between half a metre above the floor and half a metre below the ceiling, so that heights can be
    estimated; with a known ``tag_height_m`` all are below the ceiling.
    """
    high = round(max(height_m - _FROM_FLOOR_AND_CEILING_M, 0.0), 3)
    low = high if tag_height_m is not None else min(_FROM_FLOOR_AND_CEILING_M, high)
    points = [_along_walls(index / anchors, width_m, depth_m) for index in range(anchors)]
    return Site(
        name="room",
        id=1,
        master=1,
        anchors=tuple(
            AnchorSite(id=number, x_m=x, y_m=y, z_m=high if number % 2 else low)
            for number, (x, y) in enumerate(points, start=1)
        ),
        schedule=ScheduleSite(mode="free"),
        tags=TagsSite(height_m=tag_height_m),
        outline_m=rectangle(width_m, depth_m),
    )


def unplaced_site(anchors: int, tag_height_m: float | None) -> Site:
    """A site of anchors 1 to ``anchors`` without positions."""
    return Site(
        name="site",
        id=1,
        master=1,
        anchors=(),
        schedule=ScheduleSite(mode="free"),
        tags=TagsSite(height_m=tag_height_m),
        unplaced=tuple(UnplacedAnchor(id=number) for number in range(1, anchors + 1)),
    )


def grid_site(
    width_m: float, depth_m: float, spacing_m: float, height_m: float, tag_height_m: float | None = None
) -> Site:
    """A hall with a corner at (0, 0) and anchors on a square grid, about half a spacing from the walls.

    A side too long for coordinates on the air is centred on the origin.

    Raises ValueError: there are more anchors than identifiers.
    """
    x_m, y_m = _along_side(width_m, spacing_m), _along_side(depth_m, spacing_m)
    count = len(x_m) * len(y_m)
    if count > ANY_ADDRESS:
        raise ValueError(f"{count} anchors are too many: a site has identifiers for {ANY_ADDRESS}")
    points = enumerate(product(x_m, y_m), start=1)
    return Site(
        name="grid",
        id=1,
        master=1,
        anchors=tuple(AnchorSite(id=number, x_m=x, y_m=y, z_m=height_m) for number, (x, y) in points),
        schedule=ScheduleSite(mode="free"),
        tags=TagsSite(height_m=tag_height_m),
    )


def _along_side(length_m: float, spacing_m: float) -> list[float]:
    """Centred coordinates along one side, rounded to millimetres."""
    count = max(1, round(length_m / spacing_m))
    first_m = (length_m - (count - 1) * spacing_m) / 2.0
    origin_m = 0.0 if length_m <= _FARTHEST_M else length_m / 2.0
    return [round(first_m + number * spacing_m - origin_m, 3) for number in range(count)]


def _along_walls(share: float, width_m: float, depth_m: float) -> tuple[float, float]:
    """The point at a share of the way around the walls, rounded to millimetres."""
    way_m = share * 2 * (width_m + depth_m)
    if way_m <= width_m:
        x, y = way_m, 0.0
    elif way_m <= width_m + depth_m:
        x, y = width_m, way_m - width_m
    elif way_m <= 2 * width_m + depth_m:
        x, y = 2 * width_m + depth_m - way_m, depth_m
    else:
        x, y = 0.0, 2 * (width_m + depth_m) - way_m
    return round(x, 3), round(y, 3)
