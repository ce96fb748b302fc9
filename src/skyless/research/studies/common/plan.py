"""What a study is: independent cells of work, and rows of a table that come of their results."""

from collections.abc import Callable, Sequence
from typing import Any, Final, TypeVar

import numpy as np
from matplotlib.figure import Figure
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.integrity import RISK


class Plan(Struct, frozen=True):
    """How much is simulated, and with what."""

    method: str = "joint"
    seed: int = 1
    quick: bool = False
    noise_ps: float = 100.0
    """Noise of every TX and RX stamp, which filters know."""
    qa: float = 0.3
    """Process noise that filters assume at rest, m²/s³."""
    worlds: int = 12
    """Independent worlds of a case; what scatters between them gives the standard errors."""
    seconds: float = 20.0
    """True time for which each world is judged."""
    tags: int = 4
    """In each world."""
    episodes: int = 2000
    """Episodes in a case of the studies ``efficiency`` and ``integrity``."""
    integrity_risk: float = RISK
    """Stated probability that a fix's error exceeds its protection level (``integrity``)."""
    alert_limit_m: float | None = None
    """Fixes with a higher level count as not available (``integrity``)."""


_QUICK_PLAN: Final = Plan(worlds=6, seconds=10.0, tags=2, episodes=200)

_QUICK_PLANS: Final = {"room": replace(_QUICK_PLAN, worlds=3, seconds=5.0)}

_USUAL: Final = {
    "room": Plan(worlds=20, seconds=15.0, tags=5),
    "large": Plan(worlds=24, seconds=30.0),
    "survey": Plan(worlds=200, seconds=10.0),
    "survey-room": Plan(worlds=8, seconds=15.0, tags=8),
    "watch": Plan(worlds=20),
}
"""Amounts of studies that need others than the usual ones; ``room`` has fewer in all but its main cases."""


def plan_of(method: str, seed: int, *, study: str = "", quick: bool = False, **given: Any) -> Plan:  # noqa: ANN401 - of Plan
    """The usual amounts, or with ``quick`` few, where none are given."""
    usual = _QUICK_PLANS.get(study, _QUICK_PLAN) if quick else _USUAL.get(study, Plan())
    known = {name: value for name, value in given.items() if value is not None}
    return replace(usual, method=method, seed=seed, quick=quick, **known)


class Cell(Struct, frozen=True):
    """Work that shares nothing with the other cells: it may run in any process of any machine."""

    name: str
    """Name of the case to which it belongs."""
    function: Callable[[], Any]
    """A function defined at the top of a module, with its arguments."""
    weight_s: float
    """About how long it takes: the longest are begun first."""


class Limit(Struct, frozen=True):
    """What a figure of a row should be at least, at most, or both."""

    figure: str
    """Name of the row's field."""
    least: float | None = None
    most: float | None = None

    def __str__(self) -> str:
        low, high = ("" if one is None else f"{one:g}" for one in (self.least, self.most))
        return f"{self.figure}:{low}..{high}"


class Row(Struct, frozen=True, kw_only=True):
    """Results of a case; lengths in metres, None where it does not apply. All is simulated.

    Studies add figures of their own. All depends on the plan alone, except for ``MEASURED``.
    """

    study: str
    method: str
    case: str
    series: str
    """Cases of a series differ in one thing."""
    x: float | None = None
    """How much of that thing, where it is a number."""
    mesh: bool | None = None
    """None for methods that make no use of what anchors hear of each other."""
    noise_ps: float
    runs: int
    """Independent runs: worlds, or episodes."""
    fixes: int = 0
    """Fixes that were judged."""
    rmse_m: float | None = None
    rmse_error_m: float | None = None
    """Standard error of ``rmse_m``."""
    p95_m: float | None = None
    max_m: float | None = None
    said_m: float | None = None
    """Predicted by the fixes: the root of the mean trace of their covariances."""
    nees: float | None = None
    """Mean normalised error squared over the degrees of freedom: 1 for fixes whose covariances are right."""
    nees_interval: tuple[float, float] | None = None
    """Where ``nees`` lies with a probability of 99 % if they are."""
    available: float | None = None
    """Superframes with a fix over all superframes."""
    bound_m: float | None = None
    """Cramér–Rao bound of what the tag knew."""
    ratio: float | None = None
    """RMSE over the bound, or over the RMSE of another case."""
    ratio_error: float | None = None
    limit: float | None = None
    """Largest ``ratio`` that is accepted."""
    limits: tuple[Limit, ...] = ()
    """All limits of rows with more than one."""
    missed: tuple[str, ...] = ()
    """Figures outside of them."""
    passed: bool | None = None


AnyRow = TypeVar("AnyRow", bound=Row)


def with_limits(row: AnyRow, limits: Sequence[Limit]) -> AnyRow:
    """The row with its limits and the figures that miss them; without a fix all but that no level is given."""
    if row.limit is not None:
        limits = (*limits, Limit("ratio", most=row.limit))
    if not limits:
        return row
    without = () if row.fixes else tuple(one.figure for one in limits if one.figure not in {"level", "exceeded"})
    missed = missed_limits(row, limits)
    missed = tuple(one.figure for one in limits if one.figure in missed or one.figure in without)
    return replace(row, limits=tuple(limits), missed=missed, passed=not missed)


def missed_limits(row: Row, limits: Sequence[Limit]) -> tuple[str, ...]:
    """Figures outside of their limits. What does not exist exceeds nothing (levels that no fix gives)."""
    return tuple(limit.figure for limit in limits if not _holds(getattr(row, limit.figure), limit))


def _holds(value: float | None, limit: Limit) -> bool:
    if value is None:
        return limit.least is None
    return (limit.least is None or value >= limit.least) and (limit.most is None or value <= limit.most)


class Study(Struct, frozen=True):
    """A study by its parts."""

    name: str
    title: str
    cells: Callable[[Plan], list[Cell]]
    rows: Callable[[Plan, Sequence[Any]], Sequence[Row]]
    """Takes the results in the order of the cells."""
    draw: Callable[[Sequence[Any]], Figure]
    """Draws rows of its own kind."""


MEASURED: Final = ("cpu_us_per_message", "cpu_ms_per_tag_s")
"""Fields of a row that are not the same the next time."""


def seed_of(seed: int, *numbers: int) -> int:
    """A seed for one of many runs, independent of those of others."""
    return int(np.random.SeedSequence([seed, *numbers]).generate_state(1, np.uint64)[0])
