"""The pictures of the page in the README: ``.venv/bin/python docs/pictures/make.py page``.

Runs the demo, opens its page in Chromium once in each theme, writes what both show at once as an animation, and
then parts of the page in small pictures. The titles of the tabs are in the animation's EXIF data, for a test.
"""

import io
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
sys.path.insert(0, str(ROOT / "tests" / "page" / "browser"))

from page_browser import CHROMIUM, FLAGS, Visit, until  # noqa: E402 (the tests start the same browser)

SIZE = {"width": 1200, "height": 720}
TAGS = 3
FRAMES, FRAME_S = 32, 0.25
WALKED_S = 12.0
"""How long tags walk before the first frame, so that they have trails."""
DRAW_SLOWLY = (
    "period_ms => { window.requestAnimationFrame = draw => setTimeout(() => draw(performance.now()), period_ms); }"
)
"""Script: the page draws once for each frame of the animation.

At full speed a browser without a graphics card takes all processors, and the page would say that it is too slow."""
SHOWN_TABS = "tabs => tabs.filter((tab) => tab.checkVisibility()).map((tab) => tab.firstChild.textContent)"
START_S = 300.0
"""How long the demo may take to compile and to open its page."""
CALM_S = 3.0
"""After the map has begun to follow a tag."""
LIMIT_BYTES = 600_000
SMALL = {"width": 390, "height": 250}
MOVED_S = 180.0
"""How long the watch may take to name the anchor that is moved after a minute."""
IMAGE_DESCRIPTION = 0x010E
"""Of EXIF."""


def record() -> None:
    """Write ``page_light.webp`` and ``page_dark.webp``."""
    with tempfile.TemporaryDirectory() as folder:
        arguments = ["demo", "--record", "none"]
        environment = {**os.environ, "XDG_DATA_HOME": folder, "PYTHONUNBUFFERED": "1"}
        demo = subprocess.Popen(
            [sys.executable, "-m", "skyless.cli.main", *arguments],
            cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        try:
            frames, small, tabs = _frames_of(_address_of(demo))
        finally:
            demo.send_signal(signal.SIGINT)
            demo.communicate(timeout=60.0)
    for theme, pictures in frames.items():
        _write(FOLDER / f"page_{theme}.webp", pictures, tabs)
    for name, picture in small.items():
        picture.save(FOLDER / f"small_{name}.webp", quality=80, method=6)


def _address_of(demo: "subprocess.Popen[str]") -> str:
    assert demo.stdout is not None
    lines = []
    for line in demo.stdout:
        lines.append(line)
        if found := re.search(r"http://127\.0\.0\.1:\d+", line):
            return found[0]
    raise RuntimeError("the demo named no page:\n" + "".join(lines))


def _frames_of(address: str) -> tuple[dict[str, list[Image.Image]], dict[str, Image.Image], str]:
    """What the page shows in each theme, one frame after the other; parts of it by name; the titles of its tabs."""
    frames: dict[str, list[Image.Image]] = {"light": [], "dark": []}
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        visits = {theme: Visit(browser, address, viewport=SIZE, color_scheme=theme) for theme in frames}
        for visit in visits.values():
            until(visit.page, f"skyless.live.all.size >= {TAGS}", timeout_s=START_S)
            visit.page.evaluate(DRAW_SLOWLY, 1e3 * FRAME_S)
        for visit in visits.values():  # changes of the master during the start of both browsers count for a minute
            until(visit.page, "document.querySelector('#pill').classList.contains('good')", timeout_s=START_S)
        time.sleep(WALKED_S)
        begin_s = time.monotonic()
        for number in range(FRAMES):
            time.sleep(max(0.0, begin_s + number * FRAME_S - time.monotonic()))
            for theme, visit in visits.items():
                frames[theme].append(_screenshot(visit.page))
        page = visits["light"].page
        tabs = ", ".join(page.eval_on_selector_all("#tabs [role=tab]", SHOWN_TABS))
        small = {}
        for name, tab, words in (("alarms", "alarms", "Ada (tag3)"), ("survey", "anchors", "has moved")):
            page.click(f"#tab-{tab}")
            page.wait_for_selector(f"#panel-{tab} :text('{words}'):visible", timeout=1e3 * MOVED_S)
            small[name] = _part(page, f"#panel-{tab}", 0.0, 0.0)
        page.click("#tab-tags")
        page.click("#panel-tags button.name:has-text('Ada')")
        for button in ("#follow", "#zoom-in", "#zoom-in", "#zoom-in"):
            page.click(button)
        time.sleep(CALM_S)
        small["level"] = _part(page, "#map", 0.5, 0.5)
        browser.close()
    return frames, small, tabs


def _screenshot(page: Any, **options: Any) -> Image.Image:
    return Image.open(io.BytesIO(page.screenshot(**options))).convert("RGB")


def _part(page: Any, selector: str, across: float, down: float) -> Image.Image:
    """A small part of an element, which begins at these shares of what is left of its sizes."""
    box = page.locator(selector).bounding_box()
    x = box["x"] + across * max(box["width"] - SMALL["width"], 0.0)
    y = box["y"] + down * max(box["height"] - SMALL["height"], 0.0)
    return _screenshot(page, clip={"x": x, "y": y, **SMALL})


def _write(path: Path, frames: list[Image.Image], tabs: str) -> None:
    """An endless animation of no more than ``LIMIT_BYTES``, as sharp as that allows."""
    exif = Image.Exif()
    exif[IMAGE_DESCRIPTION] = tabs
    for quality in (80, 60, 45, 30):
        frames[0].save(
            path,
            save_all=True,
            append_images=frames[1:],
            duration=round(1e3 * FRAME_S),
            loop=0,
            exif=exif,
            quality=quality,
            method=6,
        )
        if path.stat().st_size <= LIMIT_BYTES:
            return
    raise RuntimeError(f"{path} has more than {LIMIT_BYTES} bytes; take fewer frames")
