"""Messages of a small site, an MQTT that only remembers, and a client of the server."""

import asyncio
import json
from itertools import count

import msgspec
from paho.mqtt.client import topic_matches_sub
from starlette.testclient import TestClient

from skyless.page.api.questions import Past
from skyless.page.app import Services, make_app
from skyless.page.connections import AccessRules
from skyless.page.playback import Playback
from skyless.page.sites import LiveSites
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.messages import SiteMessage, StatusMessage, TruthMessage, Zone
from skyless.sim.lab import lab_site
from support.site_messages import a_fix, diagonal

SITE = SiteMessage(lab_site(100.0), simulated=True, unix_s=1000.0)
SITE_ID = SITE.site.id
_SERIALS = count(1)
SQUARE = Zone("desk", "Desk", ((1.0, 1.0), (3.0, 1.0), (3.0, 3.0), (1.0, 3.0)), "#ff8800")


def fix(
    tag="t1", unix_s=1000.0, position_m=(2.0, 2.0, 1.0), std_m=0.01, velocity_mps=(0.1, 0.0, 0.0), serial=None, **more
):
    """A fix; without a number, it has a larger one than those before."""
    serial = next(_SERIALS) if serial is None else serial
    given = {"serial": serial, "unix_s": unix_s, "time_s": unix_s, "position_m": position_m, "std_m": std_m}
    given |= {"covariance_m2": diagonal(std_m**2 / 2, std_m**2 / 2), "velocity_mps": velocity_mps}
    return a_fix(tag, **given | more)


def truth(unix_s=1000.0, tag="t1", position_m=(2.0, 2.0, 1.0), velocity_mps=(0.0, 0.0, 0.0)):
    payload = {"unix_s": unix_s, "tags": {tag: (position_m, velocity_mps)}}
    return msgspec.convert(payload, TruthMessage)


def status(kind="tag", name="t1", online=True, unix_s=1.0):
    return StatusMessage(online=online, kind=kind, name=name, unix_s=unix_s)


class Times:
    """Two clocks that stand until they are moved."""

    def __init__(self):
        self.now_s, self.unix_s = 100.0, 1000.0

    def move(self, seconds):
        self.now_s += seconds
        self.unix_s += seconds


class Wire:
    """In the place of a link: keeps what is published, and echoes it as a broker does."""

    unread_s, refused = 0.0, ()
    unacknowledged = 0
    trouble = None

    def __init__(self):
        self.address = MqttAddress("broker", 1)
        self.on_state = []
        self.published = []
        self.forgotten = []
        self.handlers = {}

    def publish(self, topic, message, *, qos=0, retain=False):
        payload = message if isinstance(message, bytes) else msgspec.json.encode(message)
        self.published.append((topic, payload, qos, retain))

    def subscribe(self, topic_filter, handler, qos=0):
        self.handlers[topic_filter] = handler

    def forget(self, topic):
        self.forgotten.append(topic)

    def deliver(self, topic, message):
        payload = message if isinstance(message, bytes) else msgspec.json.encode(message)
        taken = [handler(topic, payload) for name, handler in self.handlers.items() if topic_matches_sub(name, topic)]
        assert taken, f"nobody listens to {topic}"

    def topics(self):
        return [topic for topic, *_ in self.published]


def drained(live, page=None):
    """What waits for a page, or for one that is opened now."""
    page = page or live.open_page()
    return [json.loads(message) for message in asyncio.run(asyncio.wait_for(page.drain(live.state), 1.0))]


def of(kind, messages):
    """Those of a kind."""
    return [message for message in messages if message["type"] == kind]


HERE = "http://localhost:8080"


def browser_of(live, recordings=None, *, page=None, rules=None, base_url=HERE, history=None):
    """A client of a server that shows one live site, or several, and the recordings of a folder."""
    sites = live if isinstance(live, LiveSites) else LiveSites(live)
    services = Services(sites, Playback(recordings), Past(history))
    return TestClient(make_app(services, rules or AccessRules(), **({"page": page} if page else {})), base_url=base_url)
