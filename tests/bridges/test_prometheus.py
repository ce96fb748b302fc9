"""The figures for Prometheus, read by its own Python client and promtool: counters rise, ages grow, nothing is old."""

import asyncio
import contextlib
import json
import os
import random
import re
import shutil
import subprocess
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from prometheus_client.parser import text_string_to_metric_families

from skyless.bridges import prometheus as prometheus_target
from skyless.bridges.prometheus import LATENCY_BOUNDS_S, Rising, SiteMetrics, make_target
from skyless.bridges.target import BridgeContext, Hub, Route, TargetUrl
from skyless.core.errors import SkylessError
from skyless.run.mqtt.messages import Counters, StatusMessage, TagHealth
from skyless.run.site_table import THRESHOLDS, SiteTable
from skyless.run.web import BridgeLimits
from support import site_messages
from support.bridged_values import SITE, a_fix
from support.waiting import running, until

pytestmark = pytest.mark.site

CONTEXT = BridgeContext(print)


def tag_health(tag="tag1", fixes=100, uptime_s=10.0, **more):
    return site_messages.tag_health(tag, fixes=fixes, receptions=2 * fixes, uptime_s=uptime_s, **more)


def anchor_health(**more):
    return site_messages.anchor_health(2, offset_std_m=0.012, sent=100, counters={"malformed": 3}, **more)


def read(metrics, now_s=100.0):
    """All samples: by name and labels, as Prometheus's own client reads them."""
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for one in text_string_to_metric_families(metrics.figures(now_s))
        for sample in one.samples
    }


def of_tag(name, tag="tag1", **labels):
    return (f"skyless_{name}", *sorted({"tag": tag, **labels}.items()))


class Metrics(SiteMetrics):
    """Metrics with a table, which gets the same messages."""

    def __init__(self, **more):
        super().__init__(SiteTable(0.0), **more)

    def take_fix(self, fix, now_s):
        if self.table.add_fix(fix, now_s) is not None:
            self.on_fix(fix)

    def take_health(self, health, now_s):
        kind, name = ("tag", health.tag) if isinstance(health, TagHealth) else ("anchor", str(health.anchor))
        self.table.add_health(kind, name, health, now_s)
        self.on_health(health)

    def take_status(self, status):
        self.table.add_status(status, 100.0)
        self.on_status(status)


@pytest.fixture
def metrics():
    metrics = Metrics(positions=True)
    metrics.site = SITE
    metrics.take_fix(a_fix(serial=200, latency_s=0.004, hpl_m=0.3, verified_until_s=11.7, unverified=0.25), 100.0)
    trust = {"trust": "open", "is_verified": True, "clock_error_s": -0.5, "faults": {"2": "bad-code", "3": "bad-code"}}
    metrics.take_health(tag_health(fixes=190, counters={"foreign": 2}, mqtt=Counters(50, 4, 1), **trust), 100.0)
    metrics.take_health(anchor_health(chain=2, chain_ends_unix_s=1.9e9, faults={"5": "late-frame"}), 100.0)
    metrics.take_status(StatusMessage(online=True, kind="tag", name="tag1"))
    metrics.take_status(StatusMessage(online=False, kind="anchor", name="2"))
    metrics.take_status(StatusMessage(online=True, kind="dashboard", name="pi"))
    return metrics


def test_what_is_known_of_a_tag_and_an_anchor(metrics):
    samples = read(metrics, 101.0)
    expected = {
        of_tag("tag_online"): 1,
        of_tag("tag_fixes_total"): 200,
        of_tag("tag_receptions_total"): 380,
        of_tag("tag_dropped_frames_total", reason="foreign"): 2,
        of_tag("tag_fix_age_seconds"): 1.004,
        of_tag("tag_error_std_metres"): 0.13,
        of_tag("tag_anchors"): 6,
        of_tag("tag_protection_level_metres", axis="horizontal"): 0.3,
        of_tag("tag_position_metres", axis="y"): 2.0,
        of_tag("tag_latency_seconds_count"): 1,
        of_tag("tag_latency_seconds_bucket", le="0.002"): 0,
        of_tag("tag_latency_seconds_bucket", le="0.005"): 1,
        of_tag("tag_verified"): 1,
        of_tag("tag_verified_ratio"): 0.75,
        of_tag("tag_clock_error_seconds"): -0.5,
        of_tag("tag_not_accepted", reason="bad-code"): 2,
        ("skyless_anchor_codes", ("anchor", "2")): 1,
        ("skyless_anchor_chain_end_timestamp_seconds", ("anchor", "2")): 1.9e9,
        ("skyless_anchor_not_accepted", ("anchor", "2"), ("reason", "late-frame")): 1,
        ("skyless_anchor_online", ("anchor", "2")): 0,
        ("skyless_anchor_synchronised", ("anchor", "2")): 1,
        ("skyless_anchor_offset_std_metres", ("anchor", "2")): 0.012,
        ("skyless_anchor_sent_total", ("anchor", "2")): 100,
        ("skyless_anchor_dropped_frames_total", ("anchor", "2"), ("reason", "malformed")): 3,
        ("skyless_mqtt_dropped_total", ("kind", "tag"), ("name", "tag1")): 4,
        ("skyless_mqtt_reconnects_total", ("kind", "tag"), ("name", "tag1")): 1,
    }
    assert {key: samples[key] for key in expected} == pytest.approx(expected)
    assert "dashboard" not in str(samples)


NOT_HERE = ("position_metres", "verified", "clock_error", "not_accepted", "codes", "chain_end")


def test_nothing_is_said_of_keys_where_there_are_none_nor_of_positions_unasked_and_nothing_old():
    metrics = Metrics()
    metrics.take_fix(a_fix(), 100.0)
    metrics.take_health(tag_health(), 100.0)
    metrics.take_health(anchor_health(), 100.0)
    assert not any(name in metrics.figures(100.0) for name in NOT_HERE)
    metrics.take_health(tag_health(trust="open"), 100.0)
    metrics.take_health(anchor_health(chain_ends_unix_s=1.0, code_fault="no-chain"), 100.0)
    samples = read(metrics)
    assert (samples[of_tag("tag_verified")], samples[of_tag("tag_verified_ratio")]) == (0.0, 0.0)
    assert samples["skyless_anchor_codes", ("anchor", "2")] == 0.0
    assert not any(name in metrics.figures(100.0 + 2 * THRESHOLDS.report_s) for name in NOT_HERE)


def test_the_age_of_a_killed_tag_grows_from_scrape_to_scrape_and_its_gauges_end(metrics):
    ages = [read(metrics, 100.0 + later_s)[of_tag("tag_fix_age_seconds")] for later_s in (0.0, 1.5, 3600.0)]
    assert ages == pytest.approx([0.004, 1.504, 3600.004])
    fresh, old = read(metrics, 99.9 + THRESHOLDS.fresh_s), read(metrics, 100.1 + THRESHOLDS.report_s)
    gone = {key[0] for key in fresh.keys() - old.keys()}
    assert of_tag("tag_error_std_metres")[0] in gone
    assert not any(name.endswith(("_total", "_count", "_online", "age_seconds")) for name in gone)


def test_a_restarted_tag_lets_no_counter_fall(metrics):
    metrics.take_fix(
        a_fix(serial=3, unix_s=1_795_000_000.5), 110.0
    )  # it has been started again; its health has not said so yet
    assert read(metrics)[of_tag("tag_fixes_total")] == 200
    metrics.take_health(tag_health(uptime_s=1.0, fixes=30, counters={"foreign": 1}, mqtt=Counters(5, 0, 0)), 111.0)
    samples = read(metrics)
    assert samples[of_tag("tag_fixes_total")] == 230
    assert samples[of_tag("tag_dropped_frames_total", reason="foreign")] == 3
    assert samples[("skyless_mqtt_dropped_total", ("kind", "tag"), ("name", "tag1"))] == 4
    metrics.take_fix(a_fix(serial=31, unix_s=1_795_000_001.0), 111.1)
    assert read(metrics)[of_tag("tag_fixes_total")] == 231


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 100)), max_size=30))
def test_a_counter_only_rises_whatever_comes(steps):
    counter, before = Rising(), 0
    for restarted, value in steps:
        counter.update(value, restarted=restarted)
        assert counter.total >= before
        before = counter.total


def test_nobody_can_fill_the_memory_with_names():
    metrics = Metrics()
    for k in range(3000):
        metrics.take_fix(a_fix(tag=f"t{k}"), 0.0)
    metrics.take_health(tag_health("t1", counters={f"reason{k}": 1 for k in range(200)}), 0.0)
    for name in ("x" * 100_000, "a/b", ""):
        metrics.take_fix(a_fix(tag=name), 0.0)
        metrics.take_status(StatusMessage(online=True, kind="anchor", name=name))
    assert metrics.dropped == {"too-many-names": 1000, "name": 6}
    text = metrics.figures(0.0)
    assert len(text) < 2_000_000
    assert text.count("skyless_tag_fixes_total{") == 2000
    assert text.count("skyless_tag_dropped_frames_total{") == 50


def test_a_fix_from_the_future_is_not_younger_than_new_and_lets_no_sum_fall():
    metrics = Metrics()
    metrics.take_fix(a_fix(latency_s=-100.0), 0.0)
    assert read(metrics, 10.0)[of_tag("tag_fix_age_seconds")] == 10.0
    assert read(metrics)[of_tag("tag_latency_seconds_sum")] == 0.0


@given(st.lists(st.floats(0.0, 1.0), max_size=30))
def test_a_histogram_counts_as_prometheus_does(values):
    metrics = Metrics()
    for serial, value in enumerate(values):
        metrics.take_fix(a_fix(latency_s=value, serial=serial + 1), 1.0)
    samples = read(metrics)
    for bound in LATENCY_BOUNDS_S if values else ():
        assert samples[of_tag("tag_latency_seconds_bucket", le=str(bound))] == sum(v <= bound for v in values)
    assert samples.get(of_tag("tag_latency_seconds_sum"), 0.0) == pytest.approx(sum(values))


def test_promtool_finds_nothing(metrics):
    if shutil.which("promtool") is None:
        pytest.skip("promtool is not installed: apt-get install prometheus")
    done = subprocess.run(
        ["promtool", "check", "metrics"], input=metrics.figures(100.0), capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@contextlib.asynccontextmanager
async def served():
    """A target that serves at a free port and has a fix."""
    target = make_target(TargetUrl("prometheus://"), CONTEXT)
    target.port = 0
    hub = Hub([Route(target, None, 10.0)], print)
    hub.on_site(SITE)
    hub.on_fix(a_fix(), time.monotonic())
    async with running(target.run()):
        await until(lambda: target.port)
        yield target


def exchange(*requests):
    """Answers of a target that serves; each request on a connection of its own."""

    async def talk():
        answers = []
        async with served() as target:
            for request in requests:
                reader, writer = await asyncio.open_connection("127.0.0.1", target.port)
                writer.write(request)
                writer.write_eof()
                answers.append(await reader.read())
                writer.close()
        return target, answers

    return asyncio.run(talk())


def test_it_answers_scrapes_and_nothing_else():
    _, (whole, head, other, no_page, posted) = exchange(
        b"GET /metrics?x=1 HTTP/1.1\r\nHost: localhost:9464\r\n\r\n",
        b"HEAD /metrics HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"HEAD / HTTP/1.1\r\n\r\n",
        b"POST /metrics HTTP/1.1\r\n\r\n",
    )
    first, _, body = whole.partition(b"\r\n\r\n")
    assert first.startswith(b"HTTP/1.1 200 OK\r\n")
    assert b"text/plain; version=0.0.4; charset=utf-8" in first
    assert f"Content-Length: {len(body)}".encode() in first
    assert b"skyless_tag_fixes_total" in body
    assert head.startswith(b"HTTP/1.1 200")
    assert head.endswith(b"\r\n\r\n")
    assert no_page.endswith(b"\r\n\r\n")
    assert other.startswith(b"HTTP/1.1 404")
    assert posted.startswith(b"HTTP/1.1 405")


@pytest.mark.parametrize(
    ("header", "status", "count"),
    [
        ("Host: evil.example", "421", "host"),
        ("Host: 192.0.2.1", "421", "host"),
        ("Host: localhost\r\nOrigin: http://evil.example", "403", "origin"),
        ("Host: localhost\r\nSec-Fetch-Site: cross-site", "403", "origin"),
    ],
)
def test_pages_of_other_sites_are_refused(header, status, count):
    target, (answer,) = exchange(f"GET /metrics HTTP/1.1\r\n{header}\r\n\r\n".encode())
    assert answer.startswith(f"HTTP/1.1 {status} ".encode())
    assert b"skyless_" not in answer
    assert target.dropped == {count: 1}


def test_what_is_no_request_is_counted_and_harms_nobody():
    target, answers = exchange(
        b"", b"\x00" * 100, b"A" * 20_000, b" \r\n\r\n", b"GET\r\n\r\n", b"GET /metrics HTTP/1.1\r\n\r\n"
    )
    assert target.dropped["request"] == 3
    assert answers[-1].startswith(b"HTTP/1.1 200")


async def test_connections_that_send_nothing_keep_no_scrape_out_and_end_with_the_server(monkeypatch):
    monkeypatch.setattr(prometheus_target, "LIMITS", BridgeLimits(answer_s=3600.0))
    async with served() as target:
        silent = [await asyncio.open_connection("127.0.0.1", target.port) for _ in range(100)]
        reader, writer = await asyncio.open_connection("127.0.0.1", target.port)
        writer.write(b"GET /metrics HTTP/1.1\r\n\r\n")
        assert (await reader.read()).startswith(b"HTTP/1.1 200")
    for one, other in silent:
        with contextlib.suppress(ConnectionError):
            assert await one.read() == b""
        other.close()


def test_random_requests_get_an_answer():
    """Half of them begin as a real one does; ``SKYLESS_FUZZ_FRAMES=1000000`` for a full run."""
    draws = random.Random(6)
    target = make_target(TargetUrl("prometheus://"), CONTEXT)
    for number in range(int(os.environ.get("SKYLESS_FUZZ_FRAMES", "3000"))):
        noise = b"GET /metr" * (number % 2) + draws.randbytes(draws.randrange(40))
        assert target._answer(noise).startswith(b"HTTP/1.1 ")


async def test_a_port_that_is_taken_is_named(taken):
    with pytest.raises(SkylessError, match=f"prometheus://:{taken}' cannot listen on 127.0.0.1:{taken}: "):
        await make_target(TargetUrl(f"prometheus://:{taken}"), CONTEXT).run()


DASHBOARD = json.loads((Path(__file__).parents[2] / "docs" / "tools" / "skyless_grafana.json").read_text("utf-8"))
QUERIES = [target["expr"] for panel in DASHBOARD["panels"] for target in panel["targets"]]


def test_the_dashboard_of_grafana_is_one_that_can_be_imported():
    """The keys that Grafana's import asks for; its own program cannot be had here."""
    assert [given["name"] for given in DASHBOARD["__inputs"]] == ["DS_PROMETHEUS"]
    assert {"uid", "title", "schemaVersion", "panels", "templating", "time"} <= DASHBOARD.keys()
    panels = DASHBOARD["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    assert {panel["type"] for panel in panels} == {panel["id"] for panel in DASHBOARD["__requires"][1:]}
    assert all(panel["datasource"]["uid"] == "${DS_PROMETHEUS}" for panel in panels)
    cells = [
        (x, y)
        for panel in panels
        for x in range(panel["gridPos"]["x"], panel["gridPos"]["x"] + panel["gridPos"]["w"])
        for y in range(panel["gridPos"]["y"], panel["gridPos"]["y"] + panel["gridPos"]["h"])
    ]
    assert len(set(cells)) == len(cells), "panels overlap"
    assert max(x for x, _ in cells) < 24


@pytest.mark.parametrize("query", QUERIES)
def test_every_metric_of_the_dashboard_is_served(metrics, query):
    served = {key[0] for key in read(metrics)}
    assert set(re.findall(r"skyless_\w+", query)) <= served


def test_prometheus_can_parse_every_query_of_the_dashboard(tmp_path):
    if shutil.which("promtool") is None:
        pytest.skip("promtool is not installed: apt-get install prometheus")
    replaced = [query.replace("$__rate_interval", "1m").replace("$tag", ".*") for query in QUERIES]
    rules = [{"record": f"a:r{k}", "expr": query} for k, query in enumerate(replaced)]
    file = tmp_path / "rules.yml"
    file.write_text(json.dumps({"groups": [{"name": "all", "rules": rules}]}), encoding="utf-8")
    done = subprocess.run(["promtool", "check", "rules", file], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
