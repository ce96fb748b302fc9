"""A site's computer that writes as another site: an own nats-server with a site's user, against a real hub."""

import asyncio
import json
import time

import msgspec
import numpy as np
import pytest
from pyarrow import parquet

from skyless.run import hub as hub_program
from skyless.run.broker import _program
from skyless.run.fix_batch import RECORD, Batch, encode_batch
from skyless.run.gather import subjects
from skyless.run.gather.streams import TagName
from skyless.run.gather.subjects import NatsAddress
from skyless.run.history.layout import current_files
from skyless.run.history.program import HubHistory
from skyless.run.history.writer import Keep
from skyless.run.hub import HubLink, HubSites
from skyless.run.mqtt.messages import ZonesMessage
from support.processes import free_port, started
from support.small_hub import client_of, has_stream, running_hub, site

pytestmark = pytest.mark.site

HONEST, ROGUE = 7, 8
STREAMS = {
    subjects.FIX_STREAM: ["skyless.v2.*.fixes.>", "skyless.v3.>"],
    subjects.NAMES_STREAM: ["skyless.v2.*.names.>"],
    subjects.STATE_STREAM: [subjects.at(subject, "*") for subject in subjects.STATE],
    subjects.EVENT_STREAM: [subjects.at(subject, "*") for subject in subjects.EVENTS],
}
SHAPES = (
    "v1.{}.site", "v1.{}.zones", "v1.{}.assets", "v1.{}.alarm_rules", "v1.{}.floor_plan", "v1.{}.floor_plan.1",
    "v1.{}.survey.state", "v1.{}.survey.placement", "v1.{}.survey.watch", "v1.{}.tag.t.status", "v1.{}.anchor.1.status",
    "v1.{}.zone.z.event", "v1.{}.alarm.r.s.state", "v2.{}.fixes.EVIL", "v2.{}.names.1", "v2.{}.names.2",
)  # fmt: skip
ODD = ("skyless.v1.07.site", "skyless.v3.7.site", "skyless.v1.7//.site", "skyless.v1.*7.zones")


def batch(x_mm):
    records = np.zeros(4, RECORD)
    records["tag"], records["unix_us"], records["position_mm"][:, 0] = 1, round(1e6 * time.time()), x_mm
    return encode_batch(Batch(x_mm, 1, round(1e6 * time.time()), 1, records))


def payload(subject, word):
    """What a site says of itself, of a tag and of a batch. The rest is no message and is dropped by its reader."""
    if subject.endswith(".site"):
        return msgspec.json.encode({"site": {"name": word}})
    if ".names." in subject:
        return msgspec.json.encode(TagName(word, word, 1.0))
    if ".fixes." in subject:
        return batch(1 if word == "honest" else 666)
    return msgspec.json.encode(ZonesMessage((), word))


@pytest.mark.parametrize("is_filtered", [True, False], ids=["its server filters", "it ignores the filter"])
def test_no_site_writes_as_another(is_filtered, tmp_path, monkeypatch):
    if not is_filtered:
        source = hub_program.StreamSource
        monkeypatch.setattr(hub_program, "StreamSource", lambda filter_subject, **rest: source(**rest))
    with running_hub(tmp_path) as (hub, _):
        port = free_port()
        server = {
            "server_name": "rogue",
            "listen": f"127.0.0.1:{port}",
            "jetstream": {"domain": f"site{ROGUE}", "store_dir": str(tmp_path / "rogue")},
            "leafnodes": hub.leaf("plant", ROGUE).configuration(),
        }
        (tmp_path / "rogue.json").write_text(json.dumps(server))
        with started(_program(), "-c", tmp_path / "rogue.json", limit_s=120):
            asyncio.run(_run(tmp_path, hub, NatsAddress(f"nats://127.0.0.1:{port}"), is_filtered=is_filtered))
    names = parquet.read_table(tmp_path / "history" / f"site={HONEST}" / "names.parquet")["name"].to_pylist()
    assert names == ["honest"]
    rows = [parquet.read_table(file)["x_mm"].to_pylist() for file in current_files(tmp_path / "history", HONEST)]
    assert [x for row in rows for x in row] == [1] * 4


async def _run(folder, hub, rogue_address, *, is_filtered):
    async with site(folder, hub.leaf("plant", HONEST)) as own:
        rogue, honest, tenant = [await client_of(one) for one in (rogue_address, own.nats, hub.address("plant"))]
        for old in hub_program._OF_ALL_SITES:  # as in a hub that an earlier version has made
            await tenant.jetstream().add_stream(name=old, subjects=[f"old.{old}"], max_bytes=10**6)
        for pattern, taken in STREAMS.items():
            await rogue.jetstream().add_stream(name=subjects.at(pattern, ROGUE), subjects=taken)
        for subject in [f"skyless.{one.format(HONEST)}" for one in SHAPES] + list(ODD):
            await rogue.publish(subject, payload(subject, "EVIL"))
        for subject in (f"skyless.{one.format(ROGUE)}" for one in SHAPES):
            await rogue.publish(subject, payload(subject, "rogue's own"))
        for subject in ("v1.7.site", "v1.7.zones", "v2.7.names.1", "v2.7.fixes.h"):
            await honest.publish(f"skyless.{subject}", payload(f"skyless.{subject}", "honest"))
        address = hub.address("plant")
        history = HubHistory(folder / "history", address, None, Keep(), print)
        known, seen = HubSites(address, time.monotonic()), {HONEST: [], ROGUE: []}
        links = [HubLink(address, number, "test") for number in seen]
        for link in links:
            link.subscribe("skyless/#", lambda topic, data, number=link.site: seen[number].append((topic, data)))
        work = [history.run(), known.run("test"), *(link.run() for link in links)]
        running = [asyncio.ensure_future(one) for one in work]
        stream = tenant.jetstream()

        async def held(pattern, number):
            found = await stream.stream_info(subjects.at(pattern, number), subjects_filter=">")
            return set(found.state.subjects or ())

        async with asyncio.timeout(90):
            await hub_program.make_hub_streams(tenant, hub, "plant")
            assert await hub_program.sites_at(tenant) == {HONEST, ROGUE}
            assert not any([await has_stream(tenant, old) for old in hub_program._OF_ALL_SITES])
            # A source that was made before the line was up asks again after half a minute at most.
            while history.state().fixes < 8 or not all(known.names().get(one) and seen[one] for one in seen):
                await asyncio.sleep(0.1)
        kept = {number: set.union(*[await held(pattern, number) for pattern in STREAMS]) for number in seen}
        for one in running:
            one.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        for client in (rogue, honest, tenant):
            await client.close()
    assert kept[HONEST] == {"skyless.v1.7.site", "skyless.v1.7.zones", "skyless.v2.7.names.1", "skyless.v2.7.fixes.h"}
    own = {f"skyless.{one.format(ROGUE)}" for one in SHAPES}
    assert kept[ROGUE] == own if is_filtered else kept[ROGUE] > own  # what it ignored the filter for is never read
    assert known.names() == {HONEST: "honest", ROGUE: "rogue's own"}
    assert not any(b"EVIL" in data for messages in seen.values() for _, data in messages)
    assert all(topic.startswith(f"skyless/v1/{number}/") for number, found in seen.items() for topic, _ in found)
