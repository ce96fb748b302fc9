"""Alarms through a real broker: two dashboards, a bridge that posts them, and what the broker keeps."""

import asyncio
import contextlib
import time

import pytest
from msgspec import structs

from skyless.bridges.program import BridgeNode
from skyless.bridges.target import BridgeContext, open_hub
from skyless.bridges.targets import open_route
from skyless.core.site import AlarmRule
from skyless.page.live import LiveSite
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import AlarmRulesMessage, SiteMessage, Zone, ZonesMessage
from skyless.run.mqtt.topics import alarm_rules_topic, alarm_topic, fix_topic, site_topic, zones_topic
from support.alarm_receiver import Receiver
from support.bench import LAB
from support.bridged_values import a_fix
from support.mqtt_brokers import Embedded
from support.waiting import running, until

pytestmark = pytest.mark.site

ZONE = Zone("dock", "Dock", ((0.0, 0.0), (9.0, 0.0), (9.0, 9.0), (0.0, 9.0)))
RULES = (
    AlarmRule("in", "inside", zone="dock", tags=("tag1",)),
    AlarmRule("near", "near", limit=2.0, clear_after_s=0.5),
)


@contextlib.asynccontextmanager
async def dashboard(name, address):
    live = LiveSite(name, "broker")
    link = Link(address, name, site=LAB.id, kind="dashboard")
    link.on_state.append(live.on_connection)
    live.attach(link, LAB.id)
    async with running(link.run()), running(live.run()):
        await until(lambda: live.connected)
        yield live


async def test_from_a_fix_to_a_webhook_and_on_to_the_next_dashboard(tmp_path):
    broker = Embedded(tmp_path)
    await broker.start()
    seen, places = {}, {"tag1": (1.0, 2.0, 1.5), "tag2": (1.0, 3.0, 1.5)}
    programs = Link(broker.address, "tag1", site=LAB.id, kind="tag")
    programs.subscribe(alarm_topic(LAB.id, "+", "+"), lambda topic, payload: seen.update({topic: payload}), 1)
    posted: list[str] = []

    async def send_fixes():
        while True:
            for tag, place in places.items():
                message = structs.replace(
                    a_fix(tag=tag),
                    position_m=place,
                    unix_s=time.time(),
                    covariance_m2=(1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-4),
                )
                programs.publish(fix_topic(LAB.id, tag), message)
            await asyncio.sleep(0.05)

    def is_kept(rule, subject):
        return bool(seen.get(alarm_topic(LAB.id, rule, subject)))

    with Receiver() as receiver:
        async with contextlib.AsyncExitStack() as stack:
            stack.push_async_callback(broker.stop)
            await stack.enter_async_context(running(programs.run()))
            await until(lambda: programs.connected)
            programs.publish(site_topic(LAB.id), SiteMessage(LAB, True, 0.0), qos=1, retain=True)
            programs.publish(zones_topic(LAB.id), ZonesMessage((ZONE,), LAB.name), qos=1, retain=True)
            programs.publish(alarm_rules_topic(LAB.id), AlarmRulesMessage(RULES, LAB.name), qos=1, retain=True)
            await stack.enter_async_context(running(send_fixes()))
            hub = open_hub(
                [open_route(f"webhook+http://127.0.0.1:{receiver.port}/", BridgeContext(posted.append))], posted.append
            )
            await stack.enter_async_context(running(BridgeNode(hub, broker.address, LAB.id, posted.append).run()))
            async with dashboard("first", broker.address) as first:
                await until(lambda: is_kept("in", "tag1") and is_kept("near", "tag1~tag2"))
                second = await stack.enter_async_context(dashboard("second", broker.address))
                await until(lambda: len(second.alarms.messages) == 2)
                one = next(one for one in second.alarms.messages if one.rule == "near")
                second.acknowledge(one.rule, one.subject, one.id, "Ada")
                await until(lambda: any(one.acknowledged_by == "Ada" for one in first.alarms.messages))
            await until(lambda: second.alarms.engine.leading)
            assert len(second.alarms.messages) == 2
            places["tag2"] = (8.0, 8.0, 1.5)
            await until(lambda: not is_kept("near", "tag1~tag2"))
            places["tag1"] = (20.0, 2.0, 1.5)
            await until(lambda: len(receiver.requests) == 5)
            assert sorted(receiver.types) == ["acknowledged", "ended", "ended", "raised", "raised"]
            third = await stack.enter_async_context(dashboard("third", broker.address))
            await until(lambda: len(third.alarms.messages) == 1)  # what has ended and nobody has seen is kept
            assert third.alarms.messages == second.alarms.messages
            assert third.alarms.messages[0].ended_unix_s is not None
