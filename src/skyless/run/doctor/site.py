"""Checks of a running site, from what its programs publish."""

import math
import statistics
import time
from collections import Counter

from skyless.core.geometry import RADIO_REACH_M
from skyless.core.protocols import beacon_period_s
from skyless.core.site import NoiseSite, Site, site_digest
from skyless.run.doctor.check import Check, judged, residuals_check
from skyless.run.doctor.clocks import CounterPairs, counters_check
from skyless.run.mqtt import topics
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import (
    AnchorHealth,
    FixMessage,
    RequestMessage,
    SiteMessage,
    StampsMessage,
    StatusMessage,
    TagHealth,
)
from skyless.run.process import reader

_LEASE_S = 15.0
_MAX_FIXES = 20_000
_LATE_SHARE, _VERY_LATE_SHARE = 0.1, 0.5
"""Of transmissions and of receptions, as for the page's condition."""


class SiteProbe:
    """Listens to one site."""

    def __init__(self, link: Link, number: int, name: str) -> None:
        """``name`` is the link's on MQTT."""
        self.link, self._number, self._name = link, number, name
        self._site: SiteMessage | None = None
        self._anchors: dict[int, list[AnchorHealth]] = {}
        self._tags: dict[str, list[TagHealth]] = {}
        self._fixes: list[FixMessage] = []
        self._pairs = CounterPairs()
        self._stamps: Counter[tuple[int, int]] = Counter()  # by receiver and sender
        self._stamps_s: dict[int, tuple[float, float]] = {}  # by receiver: when its first and last message came
        self._pinged_s, self._round_trips_s = 0.0, list[float]()
        for topic, kind, handle in (
            (topics.site_topic(number), SiteMessage, lambda one: setattr(self, "_site", one)),
            (topics.health_topic(number, "anchor", "+"), AnchorHealth,
             lambda one: self._anchors.setdefault(one.anchor, []).append(one)),
            (topics.health_topic(number, "tag", "+"), TagHealth,
             lambda one: self._tags.setdefault(one.tag, []).append(one)),
            (topics.fix_topic(number, "+"), FixMessage, self._on_fix),
            (topics.stamps_topic(number, "+"), StampsMessage, self._on_stamps),
            (topics.status_topic(number, "doctor", "+"), StatusMessage, self._on_status),
        ):  # fmt: skip
            link.subscribe(topic, reader(kind, handle, lambda: None))

    def request(self) -> None:
        """Ask the anchors for their stamps, for a while, and the broker for an answer."""
        request = RequestMessage(self._name, (), _LEASE_S, stamps=True)
        self.link.publish(topics.request_topic(self._number), request, qos=1)
        self._pinged_s = time.time()
        status = StatusMessage(online=True, kind="doctor", name=self._name, unix_s=self._pinged_s)
        self.link.publish(topics.status_topic(self._number, "doctor", self._name), status, qos=1, retain=True)

    def _on_status(self, status: StatusMessage) -> None:
        if status.name == self._name and status.unix_s == self._pinged_s:
            self._round_trips_s.append(time.time() - self._pinged_s)
            self._pinged_s = 0.0  # a copy does not count

    def _on_fix(self, fix: FixMessage) -> None:
        if len(self._fixes) < _MAX_FIXES:
            self._fixes.append(fix)

    def _on_stamps(self, message: StampsMessage) -> None:
        now_s, anchor = time.monotonic(), message.anchor
        first_s, _ = self._stamps_s.get(anchor, (now_s, now_s))
        self._stamps_s[anchor] = first_s, now_s
        for stamp in message.stamps:
            if first_s != now_s:  # those of the first message came before the time that is counted
                self._stamps[anchor, stamp.anchor] += 1
            self._pairs.add(f"{anchor}/{message.run}", stamp.anchor, stamp.tx_ticks, stamp.rx_ticks)

    def checks(self, file_site: Site | None) -> tuple[Check, ...]:
        """What was found; ``file_site`` is that of a site file that the running one should be."""
        broker = self._broker()
        if self._site is None:
            advice = "Start the site's anchors, or give the right --site-id."
            return broker, Check("site", "failed", f"The broker has no site of number {self._number}.", advice)
        site = self._site.whole_site
        known = self._site_check(site, file_site)
        clocks = counters_check(self._pairs, site.noise, "anchors' clocks")
        anchors = (self._slots(), self._losses(site), clocks) if self._anchors else ()
        return broker, known, self._reporting(site), *anchors, *self._tag_checks()

    def _broker(self) -> Check:
        if not self._round_trips_s:
            trouble = self.link.trouble or "it does not return what this program publishes: see the user's role"
            return Check("broker", "failed", f"{trouble[0].upper()}{trouble[1:]}.", "Start it, or give --mqtt.")
        median_s = statistics.median(self._round_trips_s)
        finding = f"{self.link.address} answers in {median_s * 1e3:.1f} ms, the median of {len(self._round_trips_s)}."
        return judged("broker", median_s, 0.1, 1.0, finding, "Use cable, and a broker near the site.")

    def _site_check(self, site: Site, file_site: Site | None) -> Check:
        simulated = ", simulated" if self._site is not None and self._site.simulated else ""
        finding = f"{site.name} with {len(site.all_anchors)} anchors{simulated}"
        if file_site is not None and site_digest(file_site) != site_digest(site):
            advice = "Start the anchors again with this file, or check the one that was surveyed last."
            return Check("site", "warning", f"{finding}; its anchors are not those of the site file.", advice)
        return Check("site", "ok", f"{finding}.")

    def _reporting(self, site: Site) -> Check:
        missing = [str(one.id) for one in site.all_anchors if one.id not in self._anchors]
        finding = f"{len(site.all_anchors) - len(missing)} of {len(site.all_anchors)} anchors report"
        if not self._anchors and self._fixes:
            finding = "No program of an anchor reports, as where the anchors are another system's."
            return Check("anchors", "not checked", finding)
        if missing:
            advice = "See their programs' logs, their power and the network."
            return Check("anchors", "failed", f"{finding}; missing: {', '.join(missing[:20])}.", advice)
        return Check("anchors", "ok", f"{finding}.")

    def _slots(self) -> Check:
        """Transmissions that were missed."""
        shares = {anchor: statistics.mean(h.missed_share for h in healths) for anchor, healths in self._anchors.items()}
        worst = max(shares, key=lambda anchor: shares[anchor])
        finding = f"Anchor {worst} misses the most transmissions: {shares[worst]:.1%}."
        advice = "Its computer is too slow or busy: end other programs there, or move anchors to another computer."
        return judged("transmissions", shares[worst], _LATE_SHARE, _VERY_LATE_SHARE, finding, advice)

    def _losses(self, site: Site) -> Check:
        """What anchors receive of those within the range in the open, against what these send."""
        places = {one.id: (one.x_m, one.y_m, one.z_m) for one in site.anchors if one.id in self._anchors}
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

    def _tag_checks(self) -> tuple[Check, ...]:
        if not self._tags:
            return (Check("tags", "not checked", "No tag is online.", "Start one: skyless tag NAME --radio ..."),)
        without = {name: healths[-1].reason for name, healths in self._tags.items() if healths[-1].reason is not None}
        finding = f"{len(self._tags) - len(without)} of {len(self._tags)} tags have a fix"
        named = ", ".join(f"{name} ({reason})" for name, reason in list(without.items())[:10])
        tags = Check("tags", "ok", f"{finding}.")
        if without:
            advice = "skyless watch and the page say what each reason means."
            tags = Check("tags", "failed", f"{finding}; not: {named}.", advice)
        late = sum(healths[-1].late - healths[0].late for healths in self._tags.values())
        received = sum(healths[-1].receptions - healths[0].receptions for healths in self._tags.values())
        share = late / max(received, late, 1)
        finding = f"Tags dropped {late} of {received} receptions as too old."
        advice = "Their computers are too slow or busy: run fewer tags on each."
        slow = judged("tags' computers", share, 0.02, _VERY_LATE_SHARE, finding, advice)
        if not self._fixes:
            return tags, slow
        return tags, slow, residuals_check("residuals", f"{len(self._fixes)} fixes", self._fixes)

    @property
    def noise(self) -> NoiseSite | None:
        """Noise figures of the site, once it is known."""
        return None if self._site is None else self._site.site.noise
