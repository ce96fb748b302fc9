"""A survey program for the page's tests: made-up results that answer to facts, and switches for what goes wrong."""

import cmath
import math
import time

TRUE = {1: 0 + 0j, 2: 4 + 0.1j, 3: 8.1 - 0.1j, 4: 8 + 6j, 5: 4.1 + 5.9j, 6: -0.1 + 6.1j}
"""Positions in metres: x + y j."""

_TURN = cmath.exp(0.35j)
NO_FACTS = {
    "dimensions": 2, "heights_m": {}, "height_std_m": 0.02, "tapes": [], "points": {}, "point_std_m": 0.005,
    "sketch_m": {}, "sketch_std_m": 0.3, "keep_positions": False, "delay_std_m": 0.07, "pair_std_m": 0.03,
    "delays": [], "gauge": None,
}  # fmt: skip


class MadeUpSurvey:
    """Its attributes are the switches of the tests; ``message`` is what the program would publish now."""

    def __init__(self, heard=(1, 2, 3, 4, 5, 6), missing=()):
        self.heard, self.missing = tuple(heard), tuple(missing)
        self.facts = dict(NO_FACTS)
        self.floor_plan = None
        self.image = None
        self.undetermined = ()
        self.excluded = ()
        self.ambiguous = False
        self.unchecked = None
        self.assumed_heights = None
        self.notes = ()
        self.error = None
        self.saves = []
        self.refuse_save = None
        self.ignores_saves = False
        self.saved_serial = self.saved_unix_s = None
        self.silent = False
        self.state = "surveyed"
        self.serial = 1
        self.given = []
        self.cleared = False
        self.started = time.time()

    def use(self, body):
        """Facts of a page, which replace those before."""
        self.given.append(body)
        self.facts = {**NO_FACTS, **body["facts"]}
        if body["floor_plan"]:
            self.floor_plan = body["floor_plan"]
        self.serial += 1

    def save(self, serial):
        """What the program does when a page has asked it to save."""
        self.saves.append(serial)
        if self.refuse_save:
            self.error = self.refuse_save
        elif not self.ignores_saves:
            self.saved_serial, self.saved_unix_s = self.serial, time.time()
            self.cleared = True  # ranges begin again: delays are others

    def message(self):
        """The message that the server forwards."""
        now = time.time()
        exchanges = int(40 * (now - self.started)) + 40
        ids = sorted(self.heard)
        pairs = [
            {"a": a, "b": b, "exchanges": exchanges, "range_m": round(abs(TRUE[a] - TRUE[b]) + 0.1, 4), "std_m": 0.004}
            for a in ids for b in ids if a < b
        ]  # fmt: skip
        survey = {
            "unix_s": now, "serial": self.serial, "anchors": ids, "missing": list(self.missing),
            "duration_s": now - self.started, "pairs": pairs, "facts": self.facts, "error": self.error,
            "survey": self._result(pairs) if len(ids) > 2 and not self.cleared else None,
            "saved_serial": self.saved_serial, "saved_unix_s": self.saved_unix_s,
            "file": "/srv/hall/site.toml", "state": self.state,
        }  # fmt: skip
        return {"type": "survey", "survey": survey, "age_s": 0.0}

    def _positions(self):
        """In the user's frame where the gauge names it, else turned and mirrored."""
        gauge = self.facts["gauge"]
        own = {n: (_TURN * point).conjugate() + 2 for n, point in TRUE.items()}
        if gauge is None:
            return own
        origin, along = own[gauge["origin"]], own[gauge["x_axis"]]
        turn = abs(along - origin) / (along - origin)
        found = {n: (point - origin) * turn for n, point in own.items()}
        if gauge["left"] is not None and found[gauge["left"]].imag < 0:
            found = {n: point.conjugate() for n, point in found.items()}
        return found

    def _result(self, pairs):
        positions, taped = self._positions(), bool(self.facts["tapes"])
        anchors = []
        for number in sorted(self.heard):
            point, known = positions[number], number not in self.undetermined
            small, large = (0.003, 0.006) if taped else (0.02, 0.07)
            angle = cmath.phase(point) + math.pi / 2
            xx = small**2 + (large**2 - small**2) * math.cos(angle) ** 2
            yy = small**2 + (large**2 - small**2) * math.sin(angle) ** 2
            xy = (large**2 - small**2) * math.sin(angle) * math.cos(angle)
            height = self.facts["heights_m"].get(str(number), 0.0)
            figures = {
                "x_m": point.real, "y_m": point.imag, "z_m": height, "std_m": math.sqrt((xx + yy) / 2),
                "covariance_m2": [[xx, xy, 0], [xy, yy, 0], [0, 0, 0]], "delay_m": 0.03, "delay_std_m": 0.02,
            }  # fmt: skip
            reason = None if known else "it is linked to one other anchor only"
            anchors.append(
                {"id": number, "determined": known, **(figures if known else dict.fromkeys(figures)), "reason": reason}
            )
        other = positions[4] + (positions[5] - positions[4]) * 1j * 0.6
        return {
            "anchors": anchors,
            "pairs": [
                {"a": p["a"], "b": p["b"], "range_m": p["range_m"], "residual_m": 0.01, "std_m": 0.03,
                 "excluded": (p["a"], p["b"]) in self.excluded} for p in pairs
            ],
            "range_std_m": 0.03, "redundancy": 4, "unchecked": self.unchecked,
            "not_determined": ["Anchors 7 and 8 are linked to one other anchor only."] if self.undetermined else [],
            "ambiguities": [{
                "sentence": "Anchor 4 could as well hang 2.3 m further to the right.", "anchors": [4],
                "positions_m": {"4": [other.real, other.imag, 0.0]},
            }] if self.ambiguous else [],
            "tapes": [] if taped else [{"a": 1, "b": 4, "std_before_m": 0.06, "std_after_m": 0.004},
                                       {"a": 3, "b": 6, "std_before_m": 0.004, "std_after_m": 0.003}],
            "frame": "anchor 1 is the origin" if self.facts["gauge"] else "nothing names the axes",
            "gauge": self.facts["gauge"], "notes": list(self.notes),
            "assumed_heights": self.assumed_heights,
        }  # fmt: skip


def watch(*findings, state="watching"):
    """A message of the watch."""
    now = time.time()
    return {
        "type": "watch",
        "watch": {"unix_s": now, "state": state, "findings": list(findings), "pairs": 28},
        "age_s": 0.0,
    }


def moved(anchor, size_m=0.11, since=1_780_000_000.0):
    """A finding of the watch."""
    sentence = f"anchor {anchor} has moved by about {100 * size_m:.0f} cm"
    return {
        "kind": "moved",
        "anchors": [anchor],
        "size_m": size_m,
        "std_m": 0.01,
        "since_unix_s": since,
        "sentence": sentence,
    }
