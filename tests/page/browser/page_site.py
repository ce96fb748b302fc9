"""A made-up site for the page's tests: anchors, walls, tags on given paths, and what they report. No radio in it."""

import math

from skyless.run.site_table import THRESHOLDS
from skyless.site.planning.colours import COLOUR_STOPS, scale_of

WIDTH_M, DEPTH_M = 24.0, 14.0
SLOT_S = 2.1e-3
SUPERFRAME = 8
COLUMNS_X = (1.0, 8.5, 15.5, 23.0)
ALERTS = ("none", "detected-excluded", "detected-not-excluded", "unavailable", "alert-limit-exceeded")


def anchor_positions():
    return [(number, x, y) for number, (x, y) in enumerate(((x, y) for y in (1.0, 13.0) for x in COLUMNS_X), start=1)]


def site_message(unix_s, floor_plan=None, mode="master", placed=True):
    walls = ((0, 0, 24, 0), (24, 0, 24, 14), (24, 14, 0, 14), (0, 14, 0, 0), (12, 0, 12, 5), (12, 9, 12, 14))
    site = {
        "name": "Hall 7",
        "id": 7,
        "master": 2,
        "anchors": [{"id": n, "x_m": x, "y_m": y, "z_m": 2.8, "slot": None} for n, x, y in anchor_positions()],
        "schedule": {"mode": mode, "slot_s": SLOT_S, "slots": None, "frames_per_node": 1, "guard_s": 0.5e-3},
        "noise": {},
        "tags": {"height_m": 1.2},
        "walls": [{"x1_m": a, "y1_m": b, "x2_m": c, "y2_m": d} for a, b, c, d in walls],
        "floor_plan": floor_plan,
        "georeference": None,
    }
    if not placed:
        site |= {"anchors": [], "unplaced": [{"id": n, "slot": None} for n in range(1, 7)], "walls": []}
    return {"site": site, "simulated": True, "unix_s": unix_s}


def names(count):
    few = ("forklift", "trolley", "robot", "drone")
    return [few[n] if count <= len(few) else f"tag-{n + 1:03d}" for n in range(count)]


def truth(number, time_s):
    """Position and velocity of a tag that goes round an ellipse of its own, in m and m/s."""
    phase, pace = 2.4 * number, 0.16 + 0.03 * (number % 5)
    across, up = 2.0 + 5.0 * (0.618 * number % 1), 1.5 + 2.5 * (0.414 * number % 1)
    angle = phase + pace * time_s
    centre_x, centre_y = 12.0 + 4.0 * math.sin(3.1 * number), 7.0 + 2.0 * math.cos(1.7 * number)
    velocity = (-across * pace * math.sin(angle), up * pace * math.cos(angle))
    return centre_x + across * math.cos(angle), centre_y + up * math.sin(angle), *velocity


def state_row(name, number, time_s, unix_s, verified=(None, None)):
    """A row of a state message, fields in the order of ``page/tracks.js``."""
    x, y, vx, vy = truth(number, time_s)
    ease = 1.0 + 0.5 * math.sin(0.3 * time_s + number)
    dx = 0.05 * ease * math.sin(9.1 * time_s + number)
    dy = 0.04 * ease * math.cos(7.7 * time_s + 2 * number)
    xx, xy, yy = (0.14 * ease) ** 2, 0.006 * ease, (0.09 * ease) ** 2
    used = 8 - (1 if math.sin(0.7 * time_s + number) > 0.6 else 0)
    chi2 = used * (0.8 + 0.6 * math.sin(5.3 * time_s + number) ** 2)
    numbers = [x + dx, y + dy, 1.2, vx, vy, xx, xy, yy, math.sqrt(xx + yy), math.hypot(dx, dy), x, y]
    estimated = name.startswith("drone")
    if estimated:
        numbers[2] = 1.5 + math.sin(0.4 * time_s)
    rest = [
        used,
        round(chi2, 3),
        unix_s,
        0.6 * ease,
        ALERTS[number % 5],
        int(not estimated),
        0.08 if estimated else None,
        *verified,
        *(THRESHOLDS.fresh_s, 0.0, THRESHOLDS.gone_s),
    ]
    return [name, *(round(value, 5) for value in numbers), *rest]


def recorded_events(start_unix_s):
    """Of a recording: anchor 2 is lost at 20 s and 4 takes over, an alert at 50 s, an anchor has moved at 70 s."""
    events = (
        (1.0, "program", "note", "recorder/demo", "recorder demo started"),
        (20.0, "anchor", "bad", "anchor/2", "anchor 2 does not report any more"),
        (20.4, "master", "warning", "anchor/4", "anchor 4 is the master now, after anchor 2"),
        (31.0, "anchor", "good", "anchor/2", "anchor 2 reports again"),
        (50.0, "alert", "warning", "tag/tag-001", "tag tag-001: faulty anchor excluded"),
        (70.0, "watch", "bad", "anchor/7", "Anchor 7 has moved by 31 cm"),
    )
    keys = ("unix_s", "kind", "level", "name", "text")
    return [
        dict(zip(keys, (start_unix_s + at_s, *rest), strict=True)) | {"serial": n}
        for n, (at_s, *rest) in enumerate(events, 1)
    ]


def mqtt():
    return {"published": 12_345, "dropped": 0, "reconnects": 0}


def phases(number, superframe):
    """When a tag worked on each message of a superframe: array per message."""
    rows = []
    for slot in range(SUPERFRAME):
        heard = slot * SLOT_S
        work = (0.00045 if slot < SUPERFRAME - 1 else 0.0009) * (1 + 0.4 * math.sin(number + slot))
        rows.append([superframe, slot, slot + 1, heard, heard + work + 0.0001 * number % 0.0005, slot >= 3])
    return rows


def tag_health(name, number, time_s, unix_s, reason=None):
    return {
        "tag": name, "unix_s": unix_s, "uptime_s": time_s, "method": "joint", "receptions": int(476 * time_s),
        "fixes": int(470 * time_s), "updates_per_s": 470 + 5 * math.sin(time_s + number), "reason": reason,
        "first_fix_s": 0.31, "latency_p50_s": 0.00042, "latency_p99_s": 0.0013 + 0.0002 * math.sin(time_s),
        "counters": {"late": 3, "foreign": 0}, "mqtt": mqtt(), "cpu": 0.021, "memory_bytes": 143_000_000,
        "phases": phases(number, int(time_s / (SUPERFRAME * SLOT_S))),
    }  # fmt: skip


def anchor_health_2(anchor, time_s, unix_s):
    """An anchor of protocol 2 knows no common time."""
    nothing = dict.fromkeys(("master", "term", "offset_s", "rate_ppm", "offset_std_m"))
    return anchor_health(anchor, time_s, unix_s) | nothing | {"mode": "free", "synchronised": True, "role": "anchor"}


def anchor_health(anchor, time_s, unix_s, synchronised=True):
    rate = 0.4 * (anchor - 4) + 0.01 * math.sin(0.2 * time_s + anchor)
    return {
        "anchor": anchor, "unix_s": unix_s, "uptime_s": time_s, "role": "master" if anchor == 2 else "anchor",
        "master": 2, "term": 1, "synchronised": synchronised,
        "offset_s": None if anchor == 2 else 0.7 * anchor - 4 + 1e-6 * rate * time_s,
        "rate_ppm": None if anchor == 2 else rate,
        "offset_std_m": None if anchor == 2 else 0.006 + 0.002 * math.sin(0.5 * time_s + anchor),
        "sent": int(59 * time_s), "late": anchor % 3, "heard": int(410 * time_s),
        "superframe": int(time_s / (SUPERFRAME * SLOT_S)),
        "heard_age_s": {str(n): 0.004 * n for n in range(1, 9) if n != anchor}, "counters": {}, "mqtt": mqtt(),
    }  # fmt: skip


def nodes():
    return [
        {"online": True, "kind": kind, "name": name, "version": "0.1.0", "host": "hall", "pid": 100 + n, "unix_s": 1.0}
        for n, (kind, name) in enumerate((("ether", "air"), ("dashboard", "page"), ("recorder", "demo")))
    ]


def reason(kind, level, text, advice="See there.", names=()):
    return {"kind": kind, "level": level, "text": text, "advice": advice, "names": names}


def condition(*reasons, level=None, text=""):
    """The server's judgement: good without reasons."""
    return {
        "type": "condition", "level": level or (reasons[0]["level"] if reasons else "good"),
        "text": text or (reasons[0]["text"] if reasons else ""), "reasons": reasons,
        "latency_p50_s": 0.0012, "latency_p99_s": 0.0034,
    }  # fmt: skip


def event(serial, unix_s, level, kind, name, text):
    return {"serial": serial, "unix_s": unix_s, "kind": kind, "level": level, "name": name, "text": text}


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
