"""A real Prometheus scrapes a bridge: rates as the tag has them, an age that grows when it is killed, no findings."""

import json
import shutil
import subprocess
import time
import urllib.parse
import urllib.request
from bisect import bisect

import msgspec
import paho.mqtt.client
import pytest
from client_site import ClientSite, Process
from paho.mqtt.enums import CallbackAPIVersion

from skyless.run.mqtt.messages import TagHealth
from support.processes import free_port
from support.waiting import came

CONFIGURATION = """
global:
  scrape_interval: 1s
  evaluation_interval: 1s
scrape_configs:
  - job_name: skyless
    static_configs:
      - targets: ["127.0.0.1:PORT"]
"""


class Prometheus:
    """A running server, and its answers."""

    def __init__(self, folder, scraped_port):
        self.port = free_port()
        file = folder / "prometheus.yml"
        file.write_text(CONFIGURATION.replace("PORT", str(scraped_port)), encoding="utf-8")
        store, address = f"--storage.tsdb.path={folder / 'store'}", f"--web.listen-address=127.0.0.1:{self.port}"
        self._process = Process("prometheus", f"--config.file={file}", store, address)
        self._process.said("Server is ready")

    def values(self, query, at_unix_s=None):
        """Value of each series by its labels, at a time."""
        asked = {"query": query} | ({} if at_unix_s is None else {"time": at_unix_s})
        url = f"http://127.0.0.1:{self.port}/api/v1/query?{urllib.parse.urlencode(asked)}"
        with urllib.request.urlopen(url) as answer:
            result = json.load(answer)["data"]["result"]
        return {tuple(sorted(one["metric"].items())): float(one["value"][1]) for one in result}

    def value(self, query, at_unix_s=None):
        """The only value; None without one."""
        values = list(self.values(query, at_unix_s).values())
        assert len(values) < 2, values
        return values[0] if values else None

    def stop(self):
        self._process.stop()


class Counted:
    """What the tag itself says that it has made."""

    def __init__(self, port):
        self.unix_s, self.fixes = [], []
        self._client = paho.mqtt.client.Client(CallbackAPIVersion.VERSION2)
        self._client.on_message = self._add
        self._client.on_connect = lambda client, *_: client.subscribe("skyless/v1/1/tag/tag1/health")
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()

    def _add(self, _client, _data, message):
        health = msgspec.json.decode(message.payload, type=TagHealth)
        self.fixes.append(health.fixes)
        self.unix_s.append(health.unix_s)  # last: a thread that reads it finds the fixes, too

    def at(self, unix_s):
        """Fixes made by a time, along a straight line between two messages."""
        k = bisect(self.unix_s, unix_s)
        (a_s, b_s), (a, b) = self.unix_s[k - 1 : k + 1], self.fixes[k - 1 : k + 1]
        return a + (b - a) * (unix_s - a_s) / (b_s - a_s)

    def stop(self):
        self._client.loop_stop()


@pytest.mark.skipif(shutil.which("prometheus") is None, reason="not installed: apt-get install prometheus")
def test_rates_are_those_of_the_tag_and_the_age_of_a_killed_one_grows(tmp_path):
    port = free_port()
    with ClientSite(tmp_path) as site:
        site.run("bridge", f"prometheus://:{port}?hz=1000").said("bridging")
        counted, prometheus = Counted(site.mqtt_port), Prometheus(tmp_path, port)
        try:
            came(lambda: (prometheus.value('skyless_tag_fixes_total{tag="tag1"}') or 0) > 500)
            time.sleep(20.0)
            # Rates over five seconds, as Prometheus and as the tag have them, at ten times: the middle one within 5 %.
            ends = [counted.unix_s[-1] - k - 0.5 for k in range(10)]
            rates = [5.0 * prometheus.value("rate(skyless_tag_fixes_total[5s])", end) for end in ends]
            made = [counted.at(end) - counted.at(end - 5.0) for end in ends]
            ratios = sorted(rate / count for rate, count in zip(rates, made, strict=True))
            assert abs(ratios[5] - 1.0) < 0.05, ratios
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
                text = answer.read()
            checked = subprocess.run(["promtool", "check", "metrics"], input=text, check=True, capture_output=True)
            assert checked.stderr == b""
            assert set(prometheus.values("up").values()) == {1.0}
            assert set(prometheus.values("skyless_anchor_synchronised").values()) == {1.0}
            assert len(prometheus.values("skyless_anchor_sent_total")) == 6
            quantile = "histogram_quantile(0.99, sum by (le) (rate(skyless_tag_latency_seconds_bucket[10s])))"
            assert 0.0 < prometheus.value(quantile) <= 0.1

            before = prometheus.value("skyless_tag_fixes_total")
            site.tag.kill()
            came(lambda: prometheus.value("skyless_tag_online") == 0.0)
            ages = []
            came(lambda: (ages.append(prometheus.value("skyless_tag_fix_age_seconds")) or ages[-1]) > 8.0)
            assert ages == sorted(ages)
            came(lambda: prometheus.value("skyless_tag_error_std_metres") is None)
            site.start_tag()
            came(lambda: prometheus.value("skyless_tag_online") == 1.0)
            came(lambda: prometheus.value("skyless_tag_fixes_total") > before + 500)
            came(lambda: prometheus.value("skyless_tag_fix_age_seconds") < 1.0)
            assert prometheus.value("resets(skyless_tag_fixes_total[5m])") == 0.0
        finally:
            counted.stop()
            prometheus.stop()
