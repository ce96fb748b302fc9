"""``skyless doctor`` at a running site: what it finds in the messages of one that is well, and of one that is not."""

from dashboard_builders import SITE, SITE_ID, Wire, fix, status
from msgspec.structs import replace

from skyless.cli.nodes.doctor import SiteProbe
from skyless.cli.nodes.site_view import SiteView
from skyless.core.ticks import TICK_RATE_HZ
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import Stamp, StampsMessage
from support.site_messages import anchor_health, tag_health


def site_messages(times, missing=(), late_share=0.0, reason=None):
    """What a small site of six anchors and a tag sends in a second."""
    yield topics.site_topic(SITE_ID), SITE
    for number in {*range(1, 7)} - {*missing}:
        health = anchor_health(number, unix_s=times.unix_s, mode="free", missed_share=late_share)
        yield topics.health_topic(SITE_ID, "anchor", number), health
        ticks = round(times.now_s * TICK_RATE_HZ) % (1 << 40)
        stamps = tuple(Stamp(other, ticks, ticks) for other in range(1, 7) if other != number)
        yield topics.stamps_topic(SITE_ID, number), StampsMessage(number, "run", times.unix_s, stamps)
    yield topics.status_topic(SITE_ID, "tag", "t1"), status()
    if reason is None:
        yield topics.fix_topic(SITE_ID, "t1"), fix(unix_s=times.unix_s)
    yield topics.health_topic(SITE_ID, "tag", "t1"), tag_health(unix_s=times.unix_s, reason=reason)


def examined_site(times, file_site=SITE.site, **wrong):
    """By name, what is found in 30 s."""
    wire = Wire()
    view = SiteView(wire, SITE_ID, lambda: times.now_s, lambda: times.unix_s)
    probe = SiteProbe(view, lambda: times.now_s)
    view._on_state(True)
    for _ in range(30):
        for topic, message in site_messages(times, **wrong):
            wire.deliver(topic, message)
        times.move(1.0)
        view.evaluate()
        probe.sample()
    assert topics.request_topic(SITE_ID) in wire.topics()
    return {check.name: check for check in probe.checks(file_site)}


def test_a_site_that_is_well(times):
    found = examined_site(times)
    results = {name: check.result for name, check in found.items()}
    assert results.pop("reception") in ("warning", "failed")  # a beacon a second of each is far too few
    assert results == dict.fromkeys(("site", "transmissions", "anchors' clocks", "residuals"), "ok")
    assert found["site"].finding == "lab (simulated): 1 of 1 tags have a fix, 6 anchors."


def test_a_site_with_faults(times):
    found = examined_site(times, replace(SITE.site, anchors=SITE.site.anchors[1:]), missing=(6,), late_share=0.3,
                          reason="no-almanac")  # fmt: skip
    wanted = {"site": "warning", "site: anchors": "warning", "site: no-fixes": "failed", "transmissions": "warning"}
    assert {name: found[name].result for name in wanted} == wanted
    assert found["site: anchors"].finding == "Anchor 6 of 6 is offline."
    assert "no almanac" in found["site: no-fixes"].finding


def test_without_a_broker_or_a_site_that_fails():
    view = SiteView(Wire(), SITE_ID)
    (check,) = SiteProbe(view).checks(None)
    assert (check.name, check.result) == ("site", "failed")
    view.link.trouble = "no connection"
    (check,) = SiteProbe(view).checks(None)
    assert (check.name, check.result, check.finding) == ("broker", "failed", "No connection.")
