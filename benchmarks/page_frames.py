"""Frames per second of the page with many moving tags, in a headless Chromium without a graphics card.

``.venv/bin/python benchmarks/page_frames.py [--tags 200] [--rate-hz 10] [--seconds 8] [--least 25] [--json]``

Trails, error ellipses, true positions and protection levels are drawn as a new page draws them; names where the page
shows them. Next to it the frames per second of an empty page on the same machine, and the processor time of the page's
thread for a frame, which other work on the machine disturbs less. Ends with 1 below ``--least`` frames per second.
"""

import argparse
import json
import sys
import time
from pathlib import Path

from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "dashboard"))
from page_browser import CHROMIUM, FLAGS, until
from page_fake_server import FakeServer

PANELS = ("tags", "timing")
GROWN_S = 6.0
"""Trails grow for this long before the measurement."""

COUNT = "() => [skyless.frames.moving, performance.now()]"
EMPTY = """(seconds) => new Promise((done) => {
  const begin = performance.now();
  let frames = 0;
  const next = () => {
    frames += 1;
    const passed_s = (performance.now() - begin) / 1e3;
    if (passed_s < seconds) requestAnimationFrame(next);
    else done(frames / passed_s);
  };
  requestAnimationFrame(next);
})"""


def measure(browser, asked, panel):
    """Figures of the page with one panel open."""
    with FakeServer(tags=asked.tags, rate_hz=asked.rate_hz) as server:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(server.address)
        until(page, f"window.skyless?.live.sorted.length === {asked.tags}", timeout_s=30.0)
        page.click(f"#tab-{panel}")
        time.sleep(GROWN_S)
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable", {"timeDomain": "threadTicks"})

        def busy_s():
            metrics = {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}
            return metrics["TaskDuration"]

        (frames, begin_ms), busy = page.evaluate(COUNT), busy_s()
        time.sleep(asked.seconds)
        (more, end_ms), after = page.evaluate(COUNT), busy_s()
        page.close()
    made = max(more - frames, 1)
    return {"frames_per_s": made / ((end_ms - begin_ms) / 1e3), "cpu_ms_per_frame": 1e3 * (after - busy) / made}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tags", type=int, default=200)
    parser.add_argument("--rate-hz", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--least", type=float, default=0.0)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page()
        empty = page.evaluate(EMPTY, 3.0)
        page.close()
        panels = {panel: measure(browser, asked, panel) for panel in PANELS}
        browser.close()
    if asked.json:
        print(json.dumps({"tags": asked.tags, "rate_hz": asked.rate_hz, "empty_frames_per_s": empty, "panels": panels}))
    else:
        print(f"empty page: {empty:.1f} frames/s")
        for panel, found in panels.items():
            rate, cpu_ms = found["frames_per_s"], found["cpu_ms_per_frame"]
            print(
                f"{asked.tags} tags at {asked.rate_hz:g} Hz, panel {panel}: {rate:.1f} frames/s, "
                f"{rate / empty:.2f} of the empty page's, {cpu_ms:.1f} ms of processor time a frame"
            )
    return int(min(found["frames_per_s"] for found in panels.values()) < asked.least)


if __name__ == "__main__":
    sys.exit(main())
