"""Pages of other programs that read Skyless: ``.venv/bin/python docs/pictures/client_pages.py``.

Runs an emulated site, a bridge, Home Assistant (of ``scripts/test clients home_assistant``) and Debian's Prometheus,
and writes what both show in Chromium: ``home_assistant.webp`` and ``prometheus.webp``.
"""

import io
import json
import sys
import tempfile
import time
import urllib.parse
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
sys.path[:0] = [str(ROOT / "tests" / "page" / "browser"), str(ROOT / "tests" / "clients")]

from client_site import ClientSite, free_port, until  # noqa: E402 (the tests run the same programs)
from page_browser import CHROMIUM, FLAGS  # noqa: E402
from test_home_assistant_client import CONFIGURATION, EAST, ENVIRONMENT, WEST, ZONES, HomeAssistant, zones_of  # noqa: E402
from test_prometheus_client import Prometheus  # noqa: E402

WALKED_S = 60.0
"""How long the tag walks before the pictures."""

GRAPH = '{__name__=~"skyless_(tag_error|anchor_offset)_std_metres"}'


def make() -> None:
    """Write both pictures."""
    with tempfile.TemporaryDirectory() as name, ClientSite(Path(name)) as site, sync_playwright() as playwright:
        port = free_port()
        site.publish(ZONES, zones_of(WEST, EAST), retain=True)
        site.run("bridge", "homeassistant:", f"prometheus://:{port}").said("bridging")
        prometheus, home = Prometheus(Path(name), port), _home(Path(name) / "home", site.mqtt_port)
        until(lambda: home.state("position") == "Hall")
        time.sleep(WALKED_S)
        end_unix_s = time.time()  # pages take the processors from the site
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        try:
            _write("home_assistant", _device_page(browser.new_page(viewport={"width": 1180, "height": 640}), home))
            page = browser.new_page(viewport={"width": 1180, "height": 900})
            _write("prometheus", _graph(page, prometheus.port, end_unix_s))
        finally:
            browser.close()
            home.stop()
            prometheus.stop()


def _home(folder: Path, mqtt_port: int) -> HomeAssistant:
    """Home Assistant with a user, as if a person had set it up."""
    (folder / ".storage").mkdir(parents=True)
    (folder / "configuration.yaml").write_text(
        CONFIGURATION.replace("PORT", str(free_port())) + "history:\nlogbook:\n", encoding="utf-8"
    )
    done = {"version": 4, "key": "onboarding", "data": {"done": ["user", "core_config", "analytics", "integration"]}}
    (folder / ".storage" / "onboarding").write_text(json.dumps(done), encoding="utf-8")
    return HomeAssistant(ENVIRONMENT / "bin" / "python", folder, mqtt_port, "ann")


def _device_page(page: Page, home: HomeAssistant) -> bytes:
    access = next(json.loads(line)["access"] for line in home.lines if line.startswith('{"access"'))
    device = home.states()["skyless_1_tag1_room"]["device"]
    page.add_init_script(f"localStorage.setItem('hassTokens', {json.dumps(json.dumps(access))})")
    page.goto(f"{access['hassUrl']}/config/devices/device/{device}")
    page.get_by_text("In East").first.wait_for()
    time.sleep(3.0)
    return page.screenshot()


def _graph(page: Page, port: int, end_unix_s: float) -> bytes:
    end = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(end_unix_s))
    asked = {"g0.expr": GRAPH, "g0.tab": 0, "g0.range_input": "50s", "g0.end_input": end, "g0.moment_input": end}
    page.goto(f"http://127.0.0.1:{port}/graph?{urllib.parse.urlencode(asked)}")
    time.sleep(6.0)
    page.evaluate("window.scrollTo(0, 0)")
    return page.screenshot()


def _write(name: str, screenshot: bytes) -> None:
    Image.open(io.BytesIO(screenshot)).save(FOLDER / f"{name}.webp", quality=85)


if __name__ == "__main__":
    make()
