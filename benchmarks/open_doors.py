"""A broker with many clients, a page and a history: real programs on loopback, made-up messages.

    python benchmarks/open_doors.py [--tags 3000] [--anchors 600]
    python benchmarks/open_doors.py --filled       # in a folder that strangers have filled with sessions

Prints the subscriptions that were refused, the memory of nats-server, and what page and history have. The exit code
is 1 where one was refused, or page or history have nothing.
"""

import argparse
import asyncio
import contextlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx2 as httpx
import psutil
from msgspec.structs import replace
from paho.mqtt import client as paho

from skyless.run.mqtt import topics
from skyless.run.mqtt.address import mqtt_address
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import FixMessage, ZoneEvent, site_message
from skyless.run.process import end_with_parent
from skyless.sim.lab import lab_site

SKYLESS = (sys.executable, "-m", "skyless.cli.main")
SITE = 1
STRANGERS, FILTERS = 17, 60
"""Sessions that the broker keeps, with as many subscriptions of QoS 1 as nats-server takes of one."""


@contextlib.contextmanager
def program(*words, folder, name, speaks=True, **variables):
    """A program of Skyless; the first line of its output, where it writes one at its start."""
    with (folder / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(
            (*SKYLESS, *words), stdout=subprocess.PIPE, stderr=log, text=True, env=os.environ | variables,
            preexec_fn=end_with_parent(),  # noqa: PLW1509 - no thread runs yet
        )  # fmt: skip
        try:
            yield process, process.stdout.readline() if speaks else ""
        finally:
            process.terminate()
            process.wait()


@contextlib.contextmanager
def broker(folder):
    """A broker with roles, to whom strangers may listen: its address, and a role's with its password."""
    subprocess.run((*SKYLESS, "broker", "access", folder / "access"), check=True, capture_output=True)
    words = ("--access", folder / "access", "--strangers-read", "--data", folder / "data", "--json")
    with program("broker", *map(str, words), folder=folder, name="broker") as (process, line):
        url = re.search(r"mqtt://[^\"]*", line)[0]

        def of(role):
            text = (folder / "access" / f"{role}.env").read_text(encoding="utf-8")
            found = dict(re.findall(r"^(\w+)=(.*)$", text, re.MULTILINE))
            return replace(mqtt_address(url), user=role, password=found["SKYLESS_MQTT_PASSWORD"])

        yield process, mqtt_address(url), of


def fill(address):
    """Sessions that the broker keeps, with many subscriptions. Each client stays until the end."""
    strangers = []
    for k in range(STRANGERS):
        one = paho.Client(paho.CallbackAPIVersion.VERSION2, f"stranger{k}", clean_session=False)
        one.connect(address.host, address.port)
        one.loop_start()
        one.subscribe([(topics.fix_topic(SITE, f"{k}-{n}"), 1) for n in range(FILTERS)])
        strangers.append(one)
    time.sleep(3.0)
    return strangers


def fix(tag):
    """A fix without meaning."""
    empty = dict.fromkeys(("velocity_mps", "velocity_covariance", "gdop", "pdop", "hdop", "vdop"))
    return FixMessage(
        tag=tag, serial=1, unix_s=time.time(), time_s=1.0, position_m=(2.0, 2.0, 1.0), std_m=0.05, chi2=1.0, dof=1,
        covariance_m2=(1e-3, 0.0, 0.0, 0.0, 1e-3, 0.0, 0.0, 0.0, 1e-3), anchors=(1, 2, 3), residual_rms_m=0.0,
        method="joint", height_known=True, latency_s=0.0, **empty,
    )  # fmt: skip


async def clients(folder, asked):
    """Many nodes, a page and a history. Whether all is granted and heard."""
    with broker(folder) as (process, address, of):
        if asked.filled:
            for stranger in fill(address):
                stranger.loop_stop()
        tags = [Link(of("tags"), f"t{k}", site=SITE, kind="tag", keepalive_s=60) for k in range(asked.tags)]
        anchors = [
            Link(of("anchors"), k, site=SITE, kind="anchor", keepalive_s=60) for k in range(1, asked.anchors + 1)
        ]
        for link in (*tags, *anchors):
            link.subscribe(topics.request_topic(SITE), lambda *_: None)
        for link in anchors:
            link.subscribe(topics.placement_topic(SITE), lambda *_: None, 1)
        message = site_message(replace(lab_site(), id=SITE), simulated=True, unix_s=1.0)
        anchors[0].publish(topics.site_topic(SITE), message, qos=1, retain=True)
        running = []
        for link in (*tags, *anchors):
            running.append(asyncio.ensure_future(link.run()))
            if len(running) % 50 == 0:
                await asyncio.sleep(0.2)
        while not all(link.connected for link in (*tags, *anchors)):
            await asyncio.sleep(0.5)
        page = of("page")
        variables = {"SKYLESS_MQTT": str(page), "SKYLESS_MQTT_PASSWORD": page.password}
        with (
            program("dashboard", "--json", folder=folder, name="dashboard", **variables) as (_, line),
            program("history", "run", "--to", str(folder / "history"), "--site-id", str(SITE), "--json",
                    folder=folder, name="history", speaks=False, **variables) as (history, _),
        ):  # fmt: skip
            await asyncio.sleep(5.0)
            speaker = Link(of("operator"), "speaker", site=SITE, kind="speaker")
            running.append(asyncio.ensure_future(speaker.run()))
            for _ in range(10):
                for k, link in enumerate(tags):
                    link.publish(topics.fix_topic(SITE, f"t{k}"), fix(f"t{k}"))
                event = ZoneEvent(
                    tag="t1", zone="a", name="A", kind="enter", unix_s=time.time(), position_m=(1.0, 1.0, 1.0)
                )
                speaker.publish(topics.zone_event_topic(SITE, "a"), event, qos=1)
                await asyncio.sleep(1.0)
            async with httpx.AsyncClient(base_url=json.loads(line)["page"]) as http:
                shown = (await http.get(f"/api/v1/site?site={SITE}")).json()
            server = next(one for one in psutil.Process(process.pid).children(recursive=True))
            memory_mb = server.memory_info().rss / 1e6
        refused = sum(len(link.refused) for link in (*tags, *anchors))
        logs = [(folder / f"{name}.log").read_text(encoding="utf-8") for name in ("dashboard", "history")]
        refused_others = sum(log.count("has refused a subscription") for log in logs)
        kept = json.loads(history.stdout.read() or "{}")
        for one in running:
            one.cancel()
        await asyncio.gather(*running, return_exceptions=True)
    print(f"{asked.tags} tags and {asked.anchors} anchors: {refused} subscriptions refused; "
          f"of page and history {refused_others}")  # fmt: skip
    print(f"nats-server {memory_mb:.0f} MB; the page has {shown['condition']['tags_with_fix']} tags with a fix, the "
          f"history {kept['fixes']} fixes and {kept['events']} events")  # fmt: skip
    return not refused and not refused_others and kept["fixes"] > 0 and kept["events"] > 0


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tags", type=int, default=3000)
    parser.add_argument("--anchors", type=int, default=600)
    parser.add_argument("--filled", action="store_true")
    asked = parser.parse_args()
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    with tempfile.TemporaryDirectory() as name:
        sys.exit(0 if asyncio.run(clients(Path(name), asked)) else 1)


if __name__ == "__main__":
    main()
