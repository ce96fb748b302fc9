"""The study ``nlos``: messages that come late: single ones, or all of an anchor, always or in bursts."""

from functools import partial
from typing import Any, Final

from skyless.research.studies.common.plan import Plan
from skyless.research.studies.common.summary import Case
from skyless.research.studies.common.worlds import anchor_of, walking
from skyless.sim.impairments import AnchorBias
from skyless.sim.world import paper_lab_site

_MAX_RATIO: Final = 1.3
_BURST_S: Final = 5.0
_MIN_S: Final = 3 * _BURST_S
"""Judged time, long enough to hold a burst no matter when it begins."""

_NOTHING_LATE: Final = "clean"


def cases(plan: Plan) -> list[Case]:
    """Single messages, then anchors, each world another one, and some of both with radios that report powers."""
    messages: list[tuple[str, dict[str, Any], float | None]] = [
        ("5 % late by exp(1 m)", {"nlos": 0.05}, None),
        ("20 % late by exp(1 m)", {"nlos": 0.2}, _MAX_RATIO),
        ("40 % late by exp(1 m)", {"nlos": 0.4}, None),
        ("20 % late by exp(0.2 m)", {"nlos": 0.2, "nlos_mean_m": 0.2}, None),
    ]
    anchors: list[tuple[str, dict[str, Any], float | None]] = [
        ("one anchor +0.1 m", {"biases": partial(_late, plan, 0.1, None)}, None),
        ("one anchor +0.3 m", {"biases": partial(_late, plan, 0.3, None)}, _MAX_RATIO),
        ("one anchor +1.5 m", {"biases": partial(_late, plan, 1.5, None)}, None),
        ("one anchor +1.5 m in bursts", {"biases": partial(_late, plan, 1.5, _BURST_S)}, _MAX_RATIO),
    ]
    reported = [
        (f"{name}, reported", {**faults, "diagnostics": True}, None)
        for name, faults, _ in (*messages[1:], anchors[2], anchors[1])
    ]
    late = [
        (name, series, faults, limit)
        for series, cases_of in (
            ("single messages", [(_NOTHING_LATE, {}, None), *messages]),
            ("one anchor", anchors),
            ("reported by the first path", reported),
        )
        for name, faults, limit in cases_of
    ]
    if plan.quick:
        late = [case for case in late if case[0] == _NOTHING_LATE or case[3] is not None]
    seconds = max(plan.seconds, _MIN_S)
    return [
        Case(name, series, None, walking(plan, seconds=seconds, **faults), _NOTHING_LATE, limit)
        for name, series, faults, limit in late
    ]


def _late(plan: Plan, bias_m: float, burst_s: float | None, number: int) -> tuple[AnchorBias, ...]:
    return (AnchorBias(anchor_of(paper_lab_site(plan.noise_ps), number).id, bias_m, burst_s),)
