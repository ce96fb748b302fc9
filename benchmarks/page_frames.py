"""Frames per second of the page with many moving tags, in a headless Chromium without a graphics card.

``.venv/bin/python benchmarks/page_frames.py [tags] [rate_hz] [seconds]``
"""

import sys
import time
from pathlib import Path

from playwright.sync_api import sync_playwright

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "dashboard"))
from page_browser import CHROMIUM, FLAGS, until
from page_fake_server import FakeServer

COUNT = "() => [skyless.frames.moving, performance.now()]"


def measure(browser, tags, rate_hz, duration_s, panel):
    with FakeServer(tags=tags, rate_hz=rate_hz) as server:
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(server.address)
        until(page, f"window.skyless?.live.sorted.length === {tags}")
        page.click(f"#tab-{panel}")
        time.sleep(6)  # trails grow
        session = page.context.new_cdp_session(page)
        session.send("Performance.enable")

        def busy():
            metrics = {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}
            return metrics["TaskDuration"], metrics["ScriptDuration"]

        (frames, begin_ms), (task, script) = page.evaluate(COUNT), busy()
        time.sleep(duration_s)
        (more, end_ms), (tasks, scripts) = page.evaluate(COUNT), busy()
        passed_s = (end_ms - begin_ms) / 1e3
        page.close()
    return (more - frames) / passed_s, (tasks - task) / passed_s, (scripts - script) / passed_s


def main():
    given = [float(text) for text in sys.argv[1:]]
    tags, rate_hz, duration_s = (*given, *(200.0, 10.0, 10.0)[len(given) :])
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        for panel in ("tags", "timing"):
            rate, task, script = measure(browser, int(tags), rate_hz, duration_s, panel)
            print(
                f"{int(tags)} tags at {rate_hz:g} Hz, panel {panel}: {rate:.1f} frames/s; "
                f"the page's thread is busy {100 * task:.0f} % of the time, {100 * script:.0f} % in scripts"
            )
        browser.close()


if __name__ == "__main__":
    main()
