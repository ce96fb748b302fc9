"""A made-up history of a site: its tags have gone their ways all the time, but for a pause every ten minutes."""

import itertools
import math

import page_site as made_up

PERIOD_S = 600.0
PAUSE_S = 120.0
ZONES = (("dock", "Dock", 14.0, 21.0, 2.5, 6.0), ("aisle", "Aisle", 2.0, 11.0, 4.0, 10.0))


def position(tag, unix_s):
    """Where a tag was, z included; None while it paused."""
    if unix_s % PERIOD_S < PAUSE_S or tag not in made_up.names(2):
        return None
    x, y, *_ = made_up.truth(made_up.names(2).index(tag), unix_s % 86_400.0)
    return x, y, 1.2


def _times(from_s, to_s, count):
    step = max((to_s - from_s) / count, 1.0)
    return [from_s + n * step for n in range(int((to_s - from_s) / step))]


def track(tag, from_s, to_s, points):
    found = [(time, position(tag, time)) for time in _times(from_s, to_s, points)]
    rows = [[time, *(round(value, 3) for value in at), 0.05, 0.4, None] for time, at in found if at]
    steps = [math.dist(a[1:3], b[1:3]) for a, b in itertools.pairwise(rows)]
    return {"tag": tag, "points": rows, "fixes": 10 * len(rows), "length_m": sum(steps)}


def heatmap(tags, from_s, to_s, cell_m):
    columns, rows = math.ceil(made_up.WIDTH_M / cell_m), math.ceil(made_up.DEPTH_M / cell_m)
    seconds = [0.0] * (columns * rows)
    times = _times(from_s, to_s, 4000)
    for tag in tags:
        for at in filter(None, (position(tag, time) for time in times)):
            seconds[int(at[1] / cell_m) * columns + int(at[0] / cell_m)] += (to_s - from_s) / len(times)
    corner = {"x0_m": 0.0, "y0_m": 0.0, "cell_m": cell_m, "columns": columns, "rows": rows}
    return {**corner, "seconds": [round(value, 3) for value in seconds], "tags": len(tags)}


def _inside(zone, at):
    return at is not None and zone[2] <= at[0] <= zone[3] and zone[4] <= at[1] <= zone[5]


def dwell(tags, from_s, to_s):
    rows = []
    for tag in tags:
        for zone in ZONES:
            times = _times(from_s, to_s, 2000)
            within = [_inside(zone, position(tag, time)) for time in times]
            visits = sum(now and not before for now, before in zip(within, [False, *within], strict=False))
            span = (to_s - from_s) / len(times)
            if visits:
                seen = [time for time, is_in in zip(times, within, strict=True) if is_in]
                first_last = {"first_unix_s": seen[0], "last_unix_s": seen[-1]}
                known = {"tag": tag, "zone": zone[0], "zone_name": zone[1], "visits": visits}
                rows.append({**known, "seconds": span * sum(within), **first_last})
    return rows


def contacts(tag, from_s, to_s, distance_m):
    other = next(name for name in made_up.names(2) if name != tag)
    rows, begun = [], None
    for time in _times(from_s, to_s, 2000):
        one, two = position(tag, time), position(other, time)
        apart = math.dist(one, two) if one and two else math.inf
        if apart <= distance_m:
            begun = begun or [time, time, apart]
            begun = [begun[0], time, min(begun[2], apart)]
        elif begun:
            both = {"tag": tag, "other": other}
            rows.append({**both, "begin_unix_s": begun[0], "end_unix_s": begun[1], "least_m": begun[2]})
            begun = None
    return rows


def answer(kind, query):
    """What ``/api/v1/history/<kind>`` answers, with a status."""
    if kind == "tags":
        return {"tags": made_up.names(2)}, 200
    from_s, to_s = float(query["from"]), float(query["to"])
    tag = query.get("tag")
    if tag not in {None, *made_up.names(2)}:
        return {"error": f"tag is {tag}; it should be a tag of the history"}, 404
    tags = [tag] if tag else made_up.names(2)
    found = {
        "track": lambda: track(tag, from_s, to_s, int(query["points"])),
        "heatmap": lambda: heatmap(tags, from_s, to_s, float(query["cell_m"])),
        "dwell": lambda: {"dwell": dwell(tags, from_s, to_s)},
        "contacts": lambda: {"contacts": contacts(tag, from_s, to_s, float(query["distance_m"]))},
    }
    return found[kind](), 200
