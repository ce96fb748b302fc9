"""A made-up site for the page's tests: anchors, walls, tags on given paths, what they report, and a history."""

import math
import time

import msgspec

from skyless.run.site_table import THRESHOLDS
from skyless.site.planning.colours import COLOUR_STOPS, scale_of
from support import site_messages

WIDTH_M, DEPTH_M = 24.0, 14.0
SLOT_S, SUPERFRAME = 2.1e-3, 8
ANCHORS = [(1 + n + 4 * up, x, y) for up, y in enumerate((1.0, 13.0)) for n, x in enumerate((1.0, 8.5, 15.5, 23.0))]
ALERTS = ("none", "detected-excluded", "detected-not-excluded", "unavailable", "alert-limit-exceeded")
WALLS = ((0, 0, 24, 0), (24, 0, 24, 14), (24, 14, 0, 14), (0, 14, 0, 0), (12, 0, 12, 5), (12, 9, 12, 14))
PLAN = {"image": "hall.png", "width_m": 24.0, "x_m": 0.0, "y_m": -1.0}
DOCK = {"id": "dock", "name": "Dock", "polygon_m": [[14, 2.5], [21, 2.5], [21, 6], [14, 6]], "colour": "#c2763a"}
RECORDED_UNIX_S, RECORDED_S, FIRST_FIX_S = 1_780_000_000.0, 90.0, 2.0


def site_message(floor_plan=None, mode="master", placed=True, **changes):
    site = {
        "name": "Hall 7", "id": 7, "master": 2, "noise": {}, "tags": {"height_m": 1.2}, "georeference": None,
        "anchors": [{"id": n, "x_m": x, "y_m": y, "z_m": 2.8, "slot": None} for n, x, y in ANCHORS],
        "schedule": {"mode": mode, "slot_s": SLOT_S, "slots": None, "frames_per_node": 1, "guard_s": 0.5e-3},
        "walls": [dict(zip(("x1_m", "y1_m", "x2_m", "y2_m"), wall, strict=True)) for wall in WALLS],
        "floor_plan": floor_plan,
    }  # fmt: skip
    if not placed:
        site |= {"anchors": [], "unplaced": [{"id": n, "slot": None} for n in range(1, 7)], "walls": []}
    return {"site": site | changes, "simulated": True, "unix_s": time.time()}


def two_floors():
    anchors = site_message()["site"]["anchors"]
    return [one | {"floor": 0} for one in anchors[:4]] + [one | {"floor": 1, "z_m": 6.0} for one in anchors[4:]]


def names(count):
    few = ("forklift", "trolley", "robot", "drone")
    return [few[n] if count <= len(few) else f"tag-{n + 1:03d}" for n in range(count)]


def truth(number, time_s):
    """Position and velocity of a tag that goes round an ellipse of its own, in m and m/s."""
    pace = 0.16 + 0.03 * (number % 5)
    angle = 2.4 * number + pace * time_s
    across, up = 2.0 + 5.0 * (0.618 * number % 1), 1.5 + 2.5 * (0.414 * number % 1)
    x, y = 12.0 + 4.0 * math.sin(3.1 * number), 7.0 + 2.0 * math.cos(1.7 * number)
    velocity = (-across * pace * math.sin(angle), up * pace * math.cos(angle))
    return x + across * math.cos(angle), y + up * math.sin(angle), *velocity


def state_row(name, number, time_s, unix_s, verified=(None, None)):
    """A row of a state message, fields in the order of ``page/tracks.js``."""
    x, y, vx, vy = truth(number, time_s)
    dx, dy = 0.05 * math.sin(9.1 * time_s + number), 0.04 * math.cos(7.7 * time_s + 2 * number)
    numbers = [x + dx, y + dy, 1.2, vx, vy, 0.02, 0.006, 0.008, 0.167, math.hypot(dx, dy), x, y]
    estimated = name.startswith("drone")
    if estimated:
        numbers[2] = 1.5 + math.sin(0.4 * time_s)
    rest = [8, 8.1, unix_s, 0.6, ALERTS[number % 5], int(not estimated), 0.08 if estimated else None, *verified]
    return [name, *(round(value, 5) for value in numbers), *rest, THRESHOLDS.fresh_s, 0.0, THRESHOLDS.gone_s]


def tag_health(name, number, time_s, unix_s, **changes):
    superframe = int(time_s / (SUPERFRAME * SLOT_S))
    phases = [(superframe, n, n + 1, n * SLOT_S, n * SLOT_S + 0.00045, n >= 3) for n in range(SUPERFRAME)]
    known = {"unix_s": unix_s, "uptime_s": time_s, "updates_per_s": 470.0, "phases": phases}
    return msgspec.to_builtins(site_messages.tag_health(name, **known)) | changes


def anchor_health(anchor, time_s, unix_s, mode="master", **changes):
    """One of a site without a master knows no common time; of the others anchor 5 does not, either."""
    others = {str(n): 0.004 * n for n in range(1, 9) if n != anchor}
    known = {"unix_s": unix_s, "uptime_s": time_s, "master": 2, "term": 1, "heard_age_s": others, "mode": mode}
    known |= {"role": "master" if anchor == 2 else "anchor", "synchronised": anchor != 5}
    known |= {"rate_ppm": 0.4 * (anchor - 4), "offset_s": 0.7 * anchor - 4 + 4e-7 * (anchor - 4) * time_s}
    if mode == "free":
        known |= dict.fromkeys(("master", "term", "offset_s", "rate_ppm", "offset_std_m"))
        known |= {"role": "anchor", "synchronised": True}
    return msgspec.to_builtins(site_messages.anchor_health(anchor, **known)) | changes


def condition(*reasons, level=None, text=""):
    """The server's judgement: good without reasons."""
    worst = reasons[0] if reasons else {"level": "good", "text": text}
    known = {"type": "condition", "level": level or worst["level"], "text": worst["text"], "reasons": reasons}
    return {**known, "latency_p50_s": 0.0012, "latency_p99_s": 0.0034}


def reason(kind, level, text, advice="See there.", names=()):
    return {"kind": kind, "level": level, "text": text, "advice": advice, "names": names}


def event(serial, unix_s, level, kind, name, text):
    return {"serial": serial, "unix_s": unix_s, "kind": kind, "level": level, "name": name, "text": text}


def asset(tag, name="", group="", **more):
    return {"tag": tag, "name": name, "group": group, "icon": "", "colour": "", "owner": "", "notes": "", **more}


def alarm(kind, subject, severity, sentence, ago_s=60.0, **more):
    since = time.time() - ago_s
    return {
        "id": f"{kind}-{subject}", "rule": kind, "name": kind, "kind": kind, "severity": severity, "subject": subject,
        "since_unix_s": since, "unix_s": since, "sentence": sentence, "tags": [], "zone": None, "place": "",
        "position_m": None, "ended_unix_s": None, "acknowledged_unix_s": None, "acknowledged_by": "", **more,
    }  # fmt: skip


def overlay(kind, step_m):
    """A smooth bowl, good in the middle; nothing beyond the walls' corners."""
    columns, rows = int(WIDTH_M / step_m) + 1, int(DEPTH_M / step_m) + 1
    scale = 0.02 if kind == "sigma" else 1.0
    values = []
    for row in range(rows):
        for column in range(columns):
            u, v = 2 * column / (columns - 1) - 1, 2 * row / (rows - 1) - 1
            values.append(None if abs(u) + abs(v) > 1.9 else round(scale * (1 + u * u + 0.7 * v * v), 4))
    known = sorted(value for value in values if value is not None)
    limits = scale_of(known)
    return {
        "kind": kind, "unit": "m" if kind == "sigma" else "1", "x_m": [0, (columns - 1) * step_m],
        "y_m": [0, (rows - 1) * step_m], "step_m": step_m, "columns": columns, "rows": rows, "values": values,
        "method": "joint", "height_m": 1.2, "least": known[0], "most": known[-1],
        "scale": {"low": limits.low, "high": limits.high, "ticks": limits.ticks, "stops": COLOUR_STOPS},
    }  # fmt: skip


def recorded_events():
    """Anchor 2 is lost at 20 s and 4 takes over, an alert at 50 s, an anchor has moved at 70 s."""
    events = (
        (1.0, "note", "program", "recorder/demo", "recorder demo started"),
        (20.0, "bad", "anchor", "anchor/2", "anchor 2 does not report any more"),
        (20.4, "warning", "master", "anchor/4", "anchor 4 is the master now, after anchor 2"),
        (31.0, "good", "anchor", "anchor/2", "anchor 2 reports again"),
        (50.0, "warning", "alert", "tag/tag-001", "tag tag-001: faulty anchor excluded"),
        (70.0, "bad", "watch", "anchor/7", "Anchor 7 has moved by 31 cm"),
    )
    return [event(n, RECORDED_UNIX_S + at_s, *rest) for n, (at_s, *rest) in enumerate(events, 1)]


def recorded_states(from_s, to_s, rate_hz):
    times = (n / rate_hz for n in range(int(max(0.0, from_s) * rate_hz), int(min(to_s, RECORDED_S) * rate_hz) + 1))
    return [
        {
            "type": "state",
            "unix_s": RECORDED_UNIX_S + at_s,
            "tags": [state_row(name, n, at_s, RECORDED_UNIX_S + at_s) for n, name in enumerate(names(2))],
        }
        for at_s in times
        if at_s >= FIRST_FIX_S
    ]


# The history: tags have gone their ways all the time, but for a pause of two minutes every ten.
PERIOD_S, PAUSE_S = 600.0, 120.0
ZONES = [DOCK, {"id": "aisle", "name": "Aisle", "polygon_m": [[2, 4], [11, 4], [11, 10], [2, 10]], "colour": None}]


def history(kind, query):
    """What ``/api/v1/history/<kind>`` answers, with a status."""
    if kind == "tags":
        return {"tags": names(2)}, 200
    from_s, to_s, tag = float(query["from"]), float(query["to"]), query.get("tag")
    if tag not in {None, *names(2)}:
        return {"error": f"tag is {tag}; it should be a tag of the history"}, 404
    if kind == "track":
        step_s = (to_s - from_s) / int(query["points"])
        times = [at for n in range(int(query["points"])) if (at := from_s + n * step_s) % PERIOD_S >= PAUSE_S]
        places = [truth(names(2).index(tag), at % 86_400.0)[:2] for at in times]
        rows = [[at, round(x, 3), round(y, 3), 1.2, 0.05, 0.4, None] for at, (x, y) in zip(times, places, strict=True)]
        return {"tag": tag, "points": rows, "fixes": 10 * len(rows), "length_m": 321.0, "gap_s": 10.0}, 200
    if kind == "heatmap":
        cell_m, columns, rows = float(query["cell_m"]), 8, 5
        seconds = [0.0 if n % 3 else 0.5 * 1.2**n for n in range(columns * rows)]
        corner = {"x0_m": 8.0, "y0_m": 5.0, "cell_m": cell_m, "columns": columns, "rows": rows}
        return {**corner, "seconds": seconds, "tags": 2}, 200
    if kind == "dwell":
        keys = ("zone", "zone_name", "tag", "visits", "seconds")
        rows = [("dock", "Dock", "forklift", 2, 70.0), ("aisle", "Aisle", "forklift", 11, 9.5)]
        rows += [("dock", "Dock", "trolley", 10, 700.5), ("aisle", "Aisle", "trolley", 4, 80.0)]
        return {"dwell": [dict(zip(keys, row, strict=True)) for row in rows if tag in {None, row[2]}]}, 200
    both = {"tag": tag, "other": next(name for name in names(2) if name != tag), "least_m": 1.4}
    begins = [from_s - from_s % PERIOD_S + n * PERIOD_S + 1.5 * PAUSE_S for n in (1, 2, 3)]
    return {"contacts": [{**both, "begin_unix_s": at, "end_unix_s": at + 30.0} for at in begins]}, 200
