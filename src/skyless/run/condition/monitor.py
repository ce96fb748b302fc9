"""The condition of the live site, in one word and with reasons. No I/O: the time is passed in.

A reason appears with the first evaluation that finds it, and disappears when none has found it for ``HOLD_S``; its
level also falls only after that time. The condition is good only on fresh evidence: the broker is connected, some tag
has a recent fix, and there is no reason against it. If nothing is known it is "waiting".
"""

from collections.abc import Collection
from typing import Final, Literal

from msgspec import Struct
from msgspec.structs import replace

from skyless.run.condition._reasons import (
    LAG_S,
    Reason,
    alert_reasons,
    anchor_reasons,
    authentication_reasons,
    behind_reason,
    broker_reason,
    busy_reason,
    fix_reasons,
    late_reason,
    left_out_reason,
    master_reason,
    multipath_reason,
    offline_anchors,
    rank,
    refused_reason,
    slow_reason,
    watch_reasons,
)
from skyless.run.condition.evidence import Evidence
from skyless.run.mqtt.messages import WatchMessage
from skyless.run.site_table import THRESHOLDS

__all__ = ["Condition", "ConditionMonitor", "offline_anchors"]

EVALUATION_S: Final = 0.5
"""Interval of the evaluations."""

HOLD_S: Final = 3.0
"""How long a reason stays after it was last found, so that the page does not flicker."""


class Condition(Struct, frozen=True):
    """How the site is, and why."""

    level: Literal["waiting", "good", "warning", "bad"]
    text: str
    """Text of the first reason, or what is being waited for. Empty if all is well."""
    reasons: tuple[Reason, ...]
    """The worst first."""
    latency_p50_s: float | None
    latency_p99_s: float | None
    """From a frame's end to the arrival of its fix at the page's server, over all tags in the last ten seconds."""
    tags: int = 0
    """Number of known tags."""
    tags_with_fix: int = 0
    anchors: int = 0
    """Anchors of the site, and others that report."""


class ConditionMonitor:
    """Evaluates evidence, and holds the reasons found for a while."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        self._held: dict[str, tuple[float, Reason]] = {}  # by kind: the reason, and the time when it was last found
        self._bad_s: dict[str, float] = {}  # by kind: time when it was last bad
        self._blind_until_s = float("-inf")

    def evaluate(
        self,
        now_s: float,
        lag_s: float = 0.0,
        watch: WatchMessage | None = None,
        watch_age_s: float | None = None,
        used_share: float | None = None,
        unread_s: float = 0.0,
        refused: Collection[str] = (),
    ) -> Condition:
        """Evaluate the condition.

        ``lag_s``: delay of the server's own work since the last evaluation. ``used_share``: share of its computer's
        processors in use, None if unknown. ``unread_s``: how long messages have waited in its own queue. ``refused``:
        subscriptions that the broker has refused.
        """
        evidence = self.evidence
        ages = evidence.ages.least_ages_s()
        latencies = evidence.ages.percentiles_s(now_s)
        if not evidence.table.connected:
            self._held.clear()
            if not evidence.table.was_connected and now_s - evidence.table.ready_s < THRESHOLDS.fresh_s:
                awaited = "the broker" if evidence.hub_trouble is None else "the site at its hub"
                return Condition("waiting", f"waiting for {awaited}", (), None, None)
            reason = broker_reason(evidence.hub_trouble)
            return Condition(reason.level, reason.text, (reason,), None, None)
        behind = behind_reason(ages, unread_s)
        found = [
            refused_reason(refused),
            behind,
            slow_reason(evidence, now_s, lag_s),
            None if evidence.table.is_empty else busy_reason(evidence, used_share),
            late_reason(evidence, ages) if behind is None else None,
            left_out_reason(evidence, now_s),
            master_reason(evidence, now_s),
            multipath_reason(evidence, now_s),
            *alert_reasons(evidence),
            *authentication_reasons(evidence, now_s),
            *watch_reasons(watch, watch_age_s),
        ]
        if lag_s > LAG_S or behind is not None:
            self._blind_until_s = now_s + 2 * EVALUATION_S  # until messages that arrived meanwhile have been read
        if not self.is_blind(now_s) and not evidence.table.is_bare:
            found += [*fix_reasons(evidence, now_s), *anchor_reasons(evidence, now_s)]
        for reason in filter(None, found):
            self._hold(reason, now_s)
        self._held = {kind: held for kind, held in self._held.items() if now_s - held[0] < HOLD_S}
        evidence.alerts.clear()
        reasons = tuple(sorted((reason for _, reason in self._held.values()), key=rank))
        tags, batched = evidence.table.senders("tag"), evidence.table.batched
        with_fix = sum(evidence.has_fix(tag, now_s) for _, tag in tags)
        with_fix += sum(not tag.is_gone for tag in batched.values())
        figures = *latencies, len(tags) + len(batched), with_fix, evidence.table.roster.size("anchor")
        if reasons:
            return Condition(reasons[0].level, reasons[0].text, reasons, *figures)
        if with_fix:
            return Condition("good", "", (), *figures)
        return Condition("waiting", self._awaited(), (), *figures)

    def is_blind(self, now_s: float) -> bool:
        """Whether messages may be missing: the broker is not connected, or the server itself was delayed."""
        return not self.evidence.table.hears or now_s < self._blind_until_s

    def _hold(self, reason: Reason, now_s: float) -> None:
        if reason.level == "bad":
            self._bad_s[reason.kind] = now_s
        elif now_s - self._bad_s.get(reason.kind, float("-inf")) < HOLD_S:
            reason = replace(reason, level="bad")
        self._held[reason.kind] = now_s, reason

    def _awaited(self) -> str:
        if self.evidence.table.site is None:
            return "waiting for the site's anchors"
        if self.evidence.table.is_bare:
            return "not set up yet: tab Set up"
        if not self.evidence.table.batched and not any(tag.online for _, tag in self.evidence.table.senders("tag")):
            return "no tag is online"
        return "waiting for the first position"
