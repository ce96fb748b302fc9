"""A survey program for the page's tests: made-up results that answer to facts, and switches for what goes wrong."""

import cmath
import time

TRUE = {1: 0 + 0j, 2: 4 + 0.1j, 3: 8.1 - 0.1j, 4: 8 + 6j, 5: 4.1 + 5.9j, 6: -0.1 + 6.1j}
"""Positions in metres: x + y j."""

_TURN = cmath.exp(0.35j)


class MadeUpSurvey:
    """Its attributes are the switches of the tests; ``message`` is what the program would publish now."""

    def __init__(self, heard=(1, 2, 3, 4, 5, 6), missing=(), ambiguous=False):
        self.heard, self.missing, self.ambiguous = tuple(heard), tuple(missing), ambiguous
        self.facts = {"dimensions": 2, "heights_m": {}, "tapes": [], "points": {}, "sketch_m": {}, "gauge": None}
        self.floor_plan = None
        self.serial, self.saved_serial, self.saved_unix_s = 1, None, None

    def use(self, body):
        """Facts of a page, which replace those before."""
        self.facts = body["facts"]
        self.floor_plan = body["floor_plan"] or self.floor_plan
        self.serial += 1

    def save(self, _serial):
        """What the program does when a page has asked it to save."""
        self.saved_serial, self.saved_unix_s = self.serial, time.time()

    def message(self):
        """The message that the server forwards."""
        ids = sorted(self.heard)
        pairs = [
            {"a": a, "b": b, "exchanges": 40, "range_m": round(abs(TRUE[a] - TRUE[b]) + 0.1, 4), "std_m": 0.004}
            for a in ids for b in ids if a < b
        ]  # fmt: skip
        survey = {
            "unix_s": time.time(), "serial": self.serial, "anchors": ids, "missing": list(self.missing),
            "duration_s": 1.0, "pairs": pairs, "facts": self.facts, "error": None,
            "survey": self._result(pairs) if len(ids) > 2 else None, "saved_serial": self.saved_serial,
            "saved_unix_s": self.saved_unix_s, "file": "/srv/hall/site.toml", "state": "surveyed",
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
        is_mirrored = gauge["left"] is not None and found[gauge["left"]].imag < 0
        return {n: point.conjugate() for n, point in found.items()} if is_mirrored else found

    def _result(self, pairs):
        positions, taped = self._positions(), bool(self.facts["tapes"])
        variance_m2 = 2e-5 if taped else 2.6e-3
        anchors = [
            {
                "id": number, "determined": True, "x_m": positions[number].real, "y_m": positions[number].imag,
                "z_m": self.facts["heights_m"].get(str(number), 0.0), "std_m": variance_m2**0.5, "reason": None,
                "covariance_m2": [[variance_m2, 0, 0], [0, variance_m2 / 4, 0], [0, 0, 0]],
            }
            for number in sorted(self.heard)
        ]  # fmt: skip
        other = positions[4] + (positions[5] - positions[4]) * 1j * 0.6
        ghost = {"sentence": "Anchor 4 could as well hang 2.3 m further to the right.", "anchors": [4]}
        tapes = ((1, 4, 0.06, 0.004), (3, 6, 0.004, 0.003))
        return {
            "anchors": anchors, "pairs": [pair | {"excluded": False} for pair in pairs], "range_std_m": 0.03,
            "redundancy": 4, "unchecked": None, "not_determined": [], "notes": [], "assumed_heights": None,
            "ambiguities": [ghost | {"positions_m": {"4": [other.real, other.imag, 0.0]}}] if self.ambiguous else [],
            "tapes": [] if taped else [
                dict(zip(("a", "b", "std_before_m", "std_after_m"), tape, strict=True)) for tape in tapes
            ],
            "frame": "anchor 1 is the origin" if self.facts["gauge"] else "nothing names the axes",
        }  # fmt: skip


def watch(*findings):
    """A message of the watch."""
    known = {"unix_s": time.time(), "state": "watching", "findings": list(findings), "pairs": 28}
    return {"type": "watch", "watch": known, "age_s": 0.0}


def moved(anchor):
    """A finding of the watch."""
    known = {"kind": "moved", "anchors": [anchor], "size_m": 0.11, "std_m": 0.01, "since_unix_s": 1_780_000_000.0}
    return {**known, "sentence": f"anchor {anchor} has moved by about 11 cm"}
