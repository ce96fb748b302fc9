"""The condition of a site for a list of many sites."""

import msgspec
import numpy as np
from msgspec.structs import replace

from skyless.run.fix_batch import RECORD
from skyless.run.gather.node import SiteCondition
from skyless.run.mqtt.messages import StatusMessage, site_message
from skyless.run.mqtt.topics import site_topic, status_topic
from skyless.sim.lab import lab_site


def a_condition():
    condition = SiteCondition(0.0)
    site = replace(lab_site(100.0), name="hall")
    condition.on_message(site_topic(7), msgspec.json.encode(site_message(site, simulated=True, unix_s=1.0)))
    return condition, [str(anchor.id) for anchor in site.anchors]


def status(name, *, online, version="1.2.3"):
    return msgspec.json.encode(StatusMessage(online=online, kind="anchor", name=name, version=version))


def heard(*tags):
    records = np.zeros(len(tags), RECORD)
    records["tag"] = tags
    return records


def test_a_site_without_fixes_is_bad_once_it_had_time_for_some():
    condition, _ = a_condition()
    assert condition.reasons({}, 0, 5.0) == ("good", [])
    assert condition.reasons({}, 0, 11.0)[0] == "bad"
    for second in range(12, 40):
        condition.on_batch(heard(1, 2) if second < 25 else heard(2), float(second))
    assert condition.tags_heard(33.0) == 2
    assert condition.tags_heard(39.5) == 1
    assert condition.reasons({}, 0, 39.5) == ("good", [])
    assert condition.reasons({}, 0, 49.5) == ("bad", ["no tag has a fix"])


def test_a_site_that_is_not_published_is_bad():
    condition = SiteCondition(0.0)
    condition.on_batch(heard(1), 1.0)
    assert condition.reasons({}, 0, 2.0)[0] == "bad"


def test_anchors_that_have_gone_and_drops_degrade():
    condition, anchors = a_condition()
    condition.on_batch(heard(1), 1.0)
    for name in (*anchors, "99"):
        condition.on_message(status_topic(7, "anchor", name), status(name, online=True))
    condition.on_message(status_topic(7, "anchor", anchors[1]), status(anchors[1], online=False))
    condition.on_message(status_topic(7, "anchor", "99"), status("99", online=False))  # not of this site any more
    condition.on_message(status_topic(7, "anchor", anchors[2]), b"broken")
    assert condition.online() == {"anchor": len(anchors) - 1}
    assert condition.versions() == {"1.2.3": len(anchors) - 1}
    assert condition.reasons({"wrong": 3}, 0, 2.0) == ("degraded", [f"1 of the anchors offline: {anchors[1]}"])
    condition.on_message(status_topic(7, "anchor", anchors[1]), status(anchors[1], online=True))
    assert condition.reasons({"wrong": 3}, 0, 3.0) == ("good", [])  # they were dropped before
    assert condition.reasons({"wrong": 5}, 6000, 4.0)[1] == [
        "6000 fixes wait for the stream",
        "2 fixes were dropped in the last minute",
    ]
    condition.on_batch(heard(1), 64.5)
    assert condition.reasons({"wrong": 5}, 0, 65.0) == ("good", [])
