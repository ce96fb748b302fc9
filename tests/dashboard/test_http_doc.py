"""Clients of the HTTP interface against a running dashboard: the programs of its document, and a generated client."""

import asyncio
import contextlib
import importlib
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
from support.loops import in_loop
from support.processes import SKYLESS, free_port, running_program

pytestmark = pytest.mark.site

DOCUMENT = Path(__file__).parents[2] / "docs" / "http.md"
ADDRESS = "127.0.0.1:8080"
PATIENCE_S = 60.0
TABLE = "tag,name,group\nt0,Forklift 1,forklifts\n"


@contextlib.asynccontextmanager
async def running_site(folder, *options):
    """A dashboard with two tags that have fixes; what it has printed."""
    broker = await start_broker(BrokerSettings(port=free_port(), data=folder / "broker"))
    link = Link(broker.address, "air", site=SITE_ID, kind="ether")
    link.publish(topics.site_topic(SITE_ID), SITE, qos=1, retain=True)
    work = [asyncio.create_task(link.run()), asyncio.create_task(_walk(link))]
    command = (*SKYLESS, "dashboard", "--json", "--mqtt", str(broker.address), *options)
    try:
        async with running_program(*command, stdout=asyncio.subprocess.PIPE) as process:
            yield json.loads(await asyncio.wait_for(process.stdout.readline(), PATIENCE_S))
    finally:
        for task in work:
            task.cancel()
        await asyncio.gather(*work, return_exceptions=True)
        await broker.stop()


async def _walk(link):
    for serial in range(1_000_000):
        for tag in ("t0", "t1"):
            position_m = (2.0 + serial % 10, 2.0, 1.0)
            link.publish(topics.fix_topic(SITE_ID, tag), fix(tag, time.time(), position_m, serial=serial))
        await asyncio.sleep(0.05)


async def known(page, tags=2, headers=None):
    """A client of the server once it knows the tags."""
    http = httpx.AsyncClient(base_url=f"{page}api/v1/", headers=headers)
    async with asyncio.timeout(PATIENCE_S):
        while len((await http.get("tags")).json().get("tags", [])) < tags:
            await asyncio.sleep(0.05)
        while (await http.get("site")).status_code != 200:
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


@in_loop
async def test_the_programs_of_the_document(tmp_path):
    async with running_site(tmp_path) as output:
        await known(output["page"])
        tags, fixes, more = await first_lines(
            output["page"], tmp_path / "client.py", program("python"), sys.executable, "-u"
        )
        assert tags == "['t0', 't1']\n"
        assert "'t0': [" in fixes
        assert "'t1': [" in fixes + more
        node = shutil.which("node")
        if node is None:
            pytest.skip("no node: apt install nodejs")
        command = (node, "--experimental-websocket")
        tags, fixes, _ = await first_lines(output["page"], tmp_path / "client.mjs", program("javascript"), *command)
        assert json.loads(tags.replace("'", '"')) == ["t0", "t1"]
        assert fixes.startswith("[ [ 't0', ")


@in_loop
async def test_a_generated_client(tmp_path, monkeypatch):
    pytest.importorskip("openapi_python_client")
    async with running_site(tmp_path) as output:
        http = await known(output["page"])
        document = tmp_path / "openapi.json"
        document.write_bytes((await http.get("openapi.json")).content)
        (tmp_path / "settings.yaml").write_text("post_hooks: []\n")
        made = await asyncio.to_thread(
            subprocess.run,
            [sys.executable, "-m", "openapi_python_client", "generate", "--path", document, "--meta", "none",
             "--config", tmp_path / "settings.yaml", "--output-path", tmp_path / "site_client"],
            capture_output=True,
            text=True,
            check=False,
        )  # fmt: skip
        assert made.returncode == 0, made.stdout + made.stderr
        monkeypatch.syspath_prepend(tmp_path)
        client = importlib.import_module("site_client").Client(base_url=output["page"].rstrip("/"))
        api = "site_client.api.site"
        models = importlib.import_module("site_client.models")

        def ask(name, **given):
            return importlib.import_module(f"{api}.{name}").sync(client=client, **given)

        assets = models.AssetsMessage([models.Asset("t0", "Forklift 1", group="forklifts")])
        await asyncio.to_thread(ask, "put_assets", body=assets)
        assert (await asyncio.to_thread(ask, "get_assets")).assets[0].name == "Forklift 1"
        answer = await asyncio.to_thread(ask, "get_tags", group="forklifts", limit=5)
        assert [(tag.tag, tag.name) for tag in answer.tags] == [("t0", "Forklift 1")]
        assert answer.tags[0].fix.position_m[1] == 2.0
        refused = await asyncio.to_thread(ask, "get_tags", limit=5000)
        assert "limit is '5000'" in refused.error


@in_loop
async def test_a_readers_token_and_a_table_that_is_kept(tmp_path):
    file = tmp_path / "assets.csv"
    file.write_text(TABLE)
    options = ("--reader-token", "readers-token-1", "--assets", str(file))
    async with running_site(tmp_path, *options) as output:
        assert output["reader_token"] == "readers-token-1"
        reader = await known(output["page"].partition("?")[0], headers={"authorization": "Bearer readers-token-1"})
        async with asyncio.timeout(PATIENCE_S):
            while not (await reader.get("assets")).json()["assets"]:  # the broker had none
                await asyncio.sleep(0.05)
        assert (await reader.put("assets.csv", content=b"tag\nt1\n")).status_code == 403
        operator = {"authorization": f"Bearer {output['token']}"}
        changed = await reader.put("assets.csv", content=b"tag;name\nt1;Ada\n", headers=operator)
        assert changed.status_code == 200
        assert [asset.name for asset in read_csv(file.read_bytes())] == ["Ada"]
