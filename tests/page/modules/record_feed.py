"""Write ``feed.jsonl``, what the page's server sends of a simulated site: ``python tests/page/modules/record_feed.py``.

The site is that of ``tests/support/live_site.py``; the server's clocks stand at the moment of each message, so that
the same is written each time. The first line has what the library and the page both know: names, and colours of values.
"""

import asyncio
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import msgspec
from paho.mqtt.client import topic_matches_sub

sys.path.append(str(Path(__file__).parents[2]))

from skyless.core.alert import Alert
from skyless.core.keys.fault import Fault
from skyless.page.live import LiveSite
from skyless.run.mqtt import topics
from skyless.run.mqtt.messages import StatusMessage, Zone
from skyless.site.planning.colours import COLOUR_STOPS, scale_of
from support import live_site
from support.site_messages import anchor_health, tag_health
from support.value_colours import colour_of

FEED = Path(__file__).with_name("feed.jsonl")
SITE, TAGS, SECONDS, STEP_S = live_site.SITE, ("a", "b"), 3.0, 0.1
WEST = Zone("west", "West", ((0.0, 0.0), (3.5, 0.0), (3.5, 6.0), (0.0, 6.0)), "#ff8800")


def known():
    """Names on the wire, and colours of values as the planner draws them."""
    values = [round(0.01 * 1.15**n, 5) for n in range(20)]
    scale = scale_of(values[3:-3])
    return {
        "alerts": [one.value for one in Alert],
        "faults": [one.value for one in Fault],
        "scale": {"low": scale.low, "high": scale.high, "stops": COLOUR_STOPS},
        "colours": [[value, *colour_of(value, scale.low, scale.high)] for value in values],
    }


def feed():
    """The lines of the file."""
    now, handlers = SimpleNamespace(s=live_site.UNIX_S), {}
    link = SimpleNamespace(
        on_state=[], unread_s=0.0, refused=(), unacknowledged=0, publish=lambda *_, **_options: None,
        subscribe=lambda topic, handler, *_: handlers.update({topic: handler}), forget=lambda _: None,
    )  # fmt: skip
    live = LiveSite("page", "mqtt://hall:1883", clock=lambda: now.s, wall_clock=lambda: now.s)
    live.attach(link, SITE.id)
    live.on_connection(connected=True)

    def deliver(topic, payload):
        for name, handler in handlers.items():
            if topic_matches_sub(name, topic):
                handler(topic, payload)

    def health(unix_s):
        for anchor in SITE.anchors[:-1]:  # the last one has not been heard
            said = anchor_health(anchor.id, unix_s=unix_s, master=None, role="anchor", heard_age_s={"1": 0.02})
            yield topics.health_topic(SITE.id, "anchor", str(anchor.id)), said
        for tag in TAGS:
            yield topics.health_topic(SITE.id, "tag", tag), tag_health(tag, unix_s=unix_s)
            yield topics.status_topic(SITE.id, "tag", tag), StatusMessage(True, "tag", tag, unix_s=unix_s)

    lines = [json.dumps({"made by": "tests/page/modules/record_feed.py", **known()})]
    said = [*live_site.messages(SECONDS, TAGS, join_s=SECONDS + 1)]
    begun, page = False, None
    for step in range(int(SECONDS / STEP_S)):
        now.s = live_site.UNIX_S + STEP_S * (step + 1)
        while said and said[0][0] <= now.s:
            deliver(*said.pop(0)[1:])
        if step % 10 == 0:
            for topic, message in health(now.s):
                deliver(topic, msgspec.json.encode(message))
        if not begun:
            live.store_zones((WEST,))
            begun, page = True, live.open_page()
        live.tick()
        lines += [message.decode() for message in asyncio.run(page.drain(live.state))]
    return "".join(f"{line}\n" for line in lines)


if __name__ == "__main__":
    FEED.write_text(feed(), encoding="utf-8")
