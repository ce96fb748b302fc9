"""Checks of a running site for ``skyless doctor``: its condition as on the page, and slower measurements."""

import math
import statistics
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from typing import Final

from skyless.cli.nodes.site_view import GONE, LINK_NAME, SiteView
from skyless.core.any_receiver import beacon_period_s
from skyless.core.geometry import RADIO_REACH_M
from skyless.core.site import Site, site_digest
from skyless.run.doctor import Check, CounterPairs, Result, counters_check, judged, residuals_check, sentence
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import FixMessage, RequestMessage, StampsMessage
from skyless.run.process import reader

_LEASE_S: Final = 15.0
_MAX_FIXES: Final = 20_000


class SiteProbe:
    """Requests the anchors' stamps, and gathers data that are judged at the end."""

    def __init__(self, view: SiteView, clock: Callable[[], float] = time.monotonic) -> None:
        self.view, self._clock = view, clock
        self._picture = view.picture()
        self._found: dict[str, Check] = {}  # by kind of the condition's reason
        self._missed: dict[str, list[float]] = {}  # by anchor
        self._fixes: deque[FixMessage] = deque(maxlen=_MAX_FIXES)
        self._pairs = CounterPairs()
        self._stamps: Counter[tuple[int, int]] = Counter()  # by receiver and sender
        self._stamps_s: dict[int, tuple[float, float]] = {}  # by receiver: times of its first and last message
        view.link.subscribe(topics.stamps_topic(view.number, "+"), reader(StampsMessage, self._on_stamps, lambda: None))

    def _on_stamps(self, message: StampsMessage) -> None:
        now_s, anchor = self._clock(), message.anchor
        first_s, _ = self._stamps_s.get(anchor, (now_s, now_s))
        self._stamps_s[anchor] = first_s, now_s
        for stamp in message.stamps:
            if first_s != now_s:  # the first message only starts the time span
                self._stamps[anchor, stamp.anchor] += 1
            self._pairs.add(f"{anchor}/{message.run}", stamp.anchor, stamp.tx_ticks, stamp.rx_ticks, now_s)

    def sample(self) -> None:
        """Gather the view's current data, and renew the request for stamps."""
        self._picture = picture = self.view.picture()
        for reason in picture.condition.reasons:
            result: Result = "failed" if reason.level == "bad" else "warning"
            if reason.kind not in self._found or result == "failed":
                self._found[reason.kind] = Check(f"site: {reason.kind}", result, sentence(reason.text), reason.advice)
        for anchor in picture.anchors:
            if anchor.health is not None and anchor.state not in GONE:
                self._missed.setdefault(anchor.anchor, []).append(anchor.health.missed_share)
        self._fixes.extend(tag.fix for tag in picture.tags if tag.fix is not None and tag.state == "fix")
        request = RequestMessage(LINK_NAME, (), _LEASE_S, stamps=True)
        self.view.link.publish(topics.request_topic(self.view.number), request)

    def known(self, file_site: Site | None, *, named: bool) -> Iterable[Check]:
        """Checks that are already final: the site if ``named``, and faults."""
        message = self.view.site
        if named and message is not None:
            yield self._site(message.whole_site, file_site)
        yield from self._found.values()

    def checks(self, file_site: Site | None) -> tuple[Check, ...]:
        """All checks; ``file_site``: the site that should be running."""
        trouble, message = self._picture.trouble, self.view.site
        if trouble is not None:
            return (broker_failed(trouble),)
        if message is None:
            advice = "Start the site's anchors, or give the right --site-id."
            return (Check("site", "failed", f"The broker has no site of number {self.view.number}.", advice),)
        site = message.whole_site
        measured = [counters_check(self._pairs, site.noise, "anchors' clocks")] if self._missed else []
        if self._missed:
            measured += [self._slots(), self._losses(site)]
        if self._fixes:
            measured.append(residuals_check("residuals", f"{len(self._fixes)} fixes looked at", self._fixes))
        return self._site(site, file_site), *self._found.values(), *measured

    def _site(self, site: Site, file_site: Site | None) -> Check:
        condition, simulated = self._picture.condition, " (simulated)" if self._picture.simulated else ""
        finding = (
            f"{site.name}{simulated}: {condition.tags_with_fix} of {condition.tags} tags have a fix, "
            f"{len(site.all_anchors)} anchors"
        )
        if file_site is not None and site_digest(file_site) != site_digest(site):
            advice = "Start the anchors again with this file, or check the one that was surveyed last."
            return Check("site", "warning", f"{finding}; the anchors are not those of the site file.", advice)
        return Check("site", "ok", f"{finding}.")

    def _slots(self) -> Check:
        """Check of missed transmissions."""
        shares = {anchor: statistics.mean(shares) for anchor, shares in self._missed.items()}
        worst, share = max(shares.items(), key=lambda one: one[1])
        finding = f"Anchor {worst} misses the most transmissions: {share:.1%}."
        advice = "Its computer is too slow or busy: end other programs there, or move anchors to another computer."
        return judged("transmissions", share, 0.1, 0.5, finding, advice)

    def _losses(self, site: Site) -> Check:
        """Check of the share of beacons that anchors receive from those within the range in the open."""
        places = {one.id: (one.x_m, one.y_m, one.z_m) for one in site.anchors if str(one.id) in self._missed}
        shares = {}
        for receiver, (first_s, last_s) in self._stamps_s.items():
            if receiver not in places or last_s - first_s < 1.0:
                continue
            sent = (last_s - first_s) / beacon_period_s(site)
            for sender, place in places.items():
                if sender != receiver and math.dist(places[receiver], place) < RADIO_REACH_M:
                    shares[receiver, sender] = self._stamps[receiver, sender] / sent
        if not shares:
            advice = "See the user's role at the broker."
            return Check("reception", "not checked", "No anchor has sent its stamps.", advice)
        (receiver, sender), worst = min(shares.items(), key=lambda one: one[1])
        finding = (
            f"Anchors receive {statistics.mean(shares.values()):.0%} of what those within {RADIO_REACH_M:.0f} m send; "
            f"anchor {receiver} receives the least, {worst:.0%} of anchor {sender}."
        )
        advice = "See what stands between them, and how their antennas are turned; skyless plan predicts walls."
        return judged("reception", -worst, -0.4, -0.05, finding, advice)


def broker_failed(trouble: str) -> Check:
    """Failed check of a broker that cannot be used."""
    advice = "Start it (skyless broker), or give another with --mqtt; --mqtt none checks no site."
    return Check("broker", "failed", sentence(trouble), advice)
