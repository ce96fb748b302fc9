"""Limits on the figures of a study's rows, and which of them a row misses."""

from collections.abc import Sequence

from msgspec.structs import replace

from skyless.studies.plan import Limit, Row


def judged(row: Row, limits: Sequence[Limit]) -> Row:
    """The row with its limits and the figures that miss them; one without a fix misses all."""
    if row.limit is not None:
        limits = (*limits, Limit("ratio", most=row.limit))
    if not limits:
        return row
    missed = tuple(limit.figure for limit in limits if row.fixes == 0 or not _holds(row, limit))
    return replace(row, limits=tuple(limits), missed=missed, passed=not missed)


def _holds(row: Row, limit: Limit) -> bool:
    """What does not exist exceeds nothing (levels that no fix gives), and reaches nothing."""
    value = getattr(row, limit.figure)
    if value is None:
        return limit.least is None
    return (limit.least is None or value >= limit.least) and (limit.most is None or value <= limit.most)
