"""Clients of the HTTP interface against a running dashboard: the programs of its document, and a generated client."""

import asyncio
import contextlib
import importlib
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import httpx2 as httpx
import pytest
from dashboard_builders import SITE, SITE_ID, fix

from skyless.run.assets import read_csv
from skyless.run.broker import BrokerSettings, start_broker
from skyless.run.mqtt import topics
from skyless.run.mqtt.link import Link
from support.processes import SKYLESS, free_port, running_program
from support.waiting import running

pytestmark = pytest.mark.site

DOCUMENT = Path(__file__).parents[2] / "docs" / "http.md"
ADDRESS = "127.0.0.1:8080"
PATIENCE_S = 60.0
TABLE = "tag,name,group\nt0,Forklift 1,forklifts\nt1,Forklift 9,forklifts\n"


@contextlib.asynccontextmanager
async def running_site(folder, *options):
    """A dashboard with two tags that have fixes; what it has printed."""
    broker = await start_broker(BrokerSettings(port=free_port(), data=folder / "broker"))
    link = Link(broker.address, "air", site=SITE_ID, kind="ether")
    link.publish(topics.site_topic(SITE_ID), SITE, qos=1, retain=True)
    command = (*SKYLESS, "dashboard", "--json", "--mqtt", str(broker.address), *options)
    async with (
        broker,
        running(link.run(), _walk(link)),
        running_program(*command, stdout=asyncio.subprocess.PIPE) as process,
    ):
        yield json.loads(await asyncio.wait_for(process.stdout.readline(), PATIENCE_S))


async def _walk(link):
    for serial in range(1_000_000):
        for tag in ("t0", "t1"):
            position_m = (2.0 + serial % 10, 2.0, 1.0)
            link.publish(topics.fix_topic(SITE_ID, tag), fix(tag, time.time(), position_m, serial=serial))
        await asyncio.sleep(0.05)


async def known(page):
    """A client of the server once it knows the tags, and what they are attached to."""
    http = httpx.AsyncClient(base_url=f"{page}api/v1/")
    async with asyncio.timeout(PATIENCE_S):
        while len((await http.get("tags", params={"group": "forklifts"})).json()["tags"]) < 2:
            await asyncio.sleep(0.05)
    return http


def program(language):
    """The only program of a language in the document."""
    (text,) = re.findall(rf"^```{language}\n(.*?)^```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert ADDRESS in text
    return text


async def first_lines(page, file, text, *command):
    """What a program for this server prints first."""
    file.write_text(text.replace(ADDRESS, page.split("/")[2]))
    async with running_program(*command, file, stdout=asyncio.subprocess.PIPE) as process:
        return [(await asyncio.wait_for(process.stdout.readline(), PATIENCE_S)).decode() for _ in range(3)]


async def test_clients_of_a_running_server(tmp_path, monkeypatch):
    file = tmp_path / "assets.csv"
    file.write_text(TABLE)
    monkeypatch.syspath_prepend(tmp_path)
    async with running_site(tmp_path, "--assets", str(file)) as output:
        page = output["page"]
        http = await known(page)  # the broker had no assets: those of the file were given to it
        document = (await http.get("openapi.json")).content
        missing = await asyncio.gather(
            in_python(page, tmp_path), in_javascript(page, tmp_path), generated(page, tmp_path, document)
        )
        assert [asset.name for asset in read_csv(file.read_bytes())] == ["Forklift 2"]
    if any(missing):
        pytest.skip("; ".join(filter(None, missing)))


async def in_python(page, folder):
    tags, fixes, more = await first_lines(page, folder / "client.py", program("python"), sys.executable, "-u")
    assert tags == "['t0', 't1']\n"
    assert "'t0': [" in fixes + more
    assert "'t1': [" in fixes + more


async def in_javascript(page, folder):
    node = shutil.which("node")
    if node is None:
        return "no node: apt install nodejs"
    command = (node, "--experimental-websocket")
    tags, fixes, _ = await first_lines(page, folder / "client.mjs", program("javascript"), *command)
    assert json.loads(tags.replace("'", '"')) == ["t0", "t1"]
    assert fixes.startswith(("[ [ 't0', ", "[ [ 't1', "))
    return None


async def generated(page, folder, document):
    """A client that openapi-python-client makes of the document."""
    if importlib.util.find_spec("openapi_python_client") is None:
        return "no openapi-python-client"
    (folder / "openapi.json").write_bytes(document)
    (folder / "settings.yaml").write_text("post_hooks: []\n")
    made = await asyncio.to_thread(
        subprocess.run,
        [sys.executable, "-m", "openapi_python_client", "generate", "--path", folder / "openapi.json", "--meta", "none",
         "--config", folder / "settings.yaml", "--output-path", folder / "site_client"],
        capture_output=True,
        text=True,
        check=False,
    )  # fmt: skip
    assert made.returncode == 0, made.stdout + made.stderr
    client = importlib.import_module("site_client").Client(base_url=page.rstrip("/"))
    models = importlib.import_module("site_client.models")

    async def ask(name, **given):
        operation = importlib.import_module(f"site_client.api.site.{name}")
        return await asyncio.to_thread(operation.sync, client=client, **given)

    assets = models.AssetsMessage([models.Asset("t0", "Forklift 2", group="forklifts")])
    await ask("put_assets", body=assets)
    assert (await ask("get_assets")).assets[0].name == "Forklift 2"
    answer = await ask("get_tags", group="forklifts", limit=5)
    assert [(tag.tag, tag.name) for tag in answer.tags] == [("t0", "Forklift 2")]
    assert answer.tags[0].fix.position_m[1] == 2.0
    site = await ask("get_site")
    assert (site.site.id, site.simulated) == (SITE_ID, True)
    refused = await ask("get_tags", limit=5000)
    assert "limit is '5000'" in refused.error
    return None
