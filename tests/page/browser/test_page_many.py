"""Very many tags: the page asks the binary stream for its view, and draws points, or counts in cells."""

import json
import math
import struct
import time

import numpy as np
import pytest
from page_browser import THREE_FRAMES, until

pytestmark = pytest.mark.statistical

POINT = np.dtype([("tag", "<u4"), ("x", "<u2"), ("y", "<u2"), ("sigma_mm", "<u2"), ("age", "u1"), ("alert", "u1")])
ANCHOR = np.dtype([("id", "<u2"), ("x", "<i4"), ("y", "<i4"), ("z", "<i2"), ("floor", "u1"), ("zero", "u1")])
LEFT_M, RIGHT_M, Y_M = 3.0, 21.0, 7.0

PIXEL = """([x, y]) => {
  const canvas = document.getElementById("moving");
  const context = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d", { willReadFrequently: true });
  context.drawImage(canvas, 0, 0);
  const box = canvas.getBoundingClientRect();
  return [...context.getImageData(Math.round(x - box.left), Math.round(y - box.top), 1, 1).data];
}"""


def head(kind, count, unix_us):
    return struct.pack("<BBHQ", ord(kind), 0, count, unix_us)


class Crowd:
    """Tags at two places of the hall, as points or as counts, and two anchors."""

    def __init__(self):
        self.asked, self.counted, self.spoilt = [], False, False

    def __call__(self, asked):
        self.asked.append(asked)
        unix_us = round(1e6 * (time.time() + 1.0))  # later than any delay that the page reckons with
        anchors = np.array([(1, 1000, 1000, 280, 0, 0), (2, 8500, 1000, 280, 0, 0)], ANCHOR)
        found = self.counts(asked, unix_us) if self.counted else self.points(asked, unix_us)
        names = {number: f"t{number}" for number in asked["named"]}
        named = head("N", len(names), unix_us) + json.dumps(names).encode()
        return [
            *([named] if names else []),
            head("A", 2, unix_us) + anchors.tobytes(),
            found[:-1] if self.spoilt else found,
        ]

    def points(self, asked, unix_us):
        x0, y0, x1, y1 = asked["view"]
        points = np.zeros(1000, POINT)
        points["tag"], points["alert"] = np.arange(1000), 1
        points["x"] = np.where(points["tag"] % 2, *(round(65535 * (x - x0) / (x1 - x0)) for x in (LEFT_M, RIGHT_M)))
        points["y"] = round(65535 * (Y_M - y0) / (y1 - y0))
        points["age"] = np.where(points["tag"] % 2, 0, 40)
        return head("P", len(points), unix_us) + points.tobytes()

    def counts(self, asked, unix_us):
        x0, y0, x1, y1 = asked["view"]
        cell = 8
        columns, rows = (math.ceil(px / cell) for px in asked["px"])
        counts = np.zeros((rows, columns), "<u2")
        at = [
            int((p - a) / (b - a) * px / cell)
            for p, a, b, px in zip((LEFT_M, Y_M), (x0, y0), (x1, y1), asked["px"], strict=True)
        ]
        counts[at[1], at[0]] = 6000
        counts[0, 0] = 7
        return struct.pack("<BBHHHQ", ord("B"), cell, columns, rows, 0, unix_us) + counts.tobytes()


def test_points_and_counts(serve, visit):
    server = serve(tags=0)
    crowd = server.live2 = Crowd()
    shown = visit(server)
    page = shown.page
    part = "document.getElementById('part').textContent"
    until(page, f"{part} === '1\\u202f000 tags are shown as points'")
    page.evaluate(THREE_FRAMES)

    def seen(x_m):
        page.evaluate(THREE_FRAMES)
        return page.evaluate(PIXEL, shown.at(x_m, Y_M))

    fresh, old = seen(LEFT_M), seen(RIGHT_M)
    assert [fresh[3], old[3]] == [255, 255]
    assert max(fresh[:3]) - min(fresh[:3]) > 60 > max(old[:3]) - min(old[:3]), "tags that are not heard are grey"

    # The nearest point is selected; the server is asked for its name.
    page.mouse.click(*shown.at(LEFT_M, Y_M))
    until(page, "/^t[0-9]*[13579]$/.test(skyless.state.selection.tag)")

    # The map is moved: points stay where they are in the hall, and the new view is asked for.
    views = len({tuple(asked["view"]) for asked in crowd.asked})
    page.focus("#canvas")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("+")
    assert seen(LEFT_M) == fresh
    until(page, f"{part}.includes('points')")
    deadline = time.monotonic() + 5
    while len({tuple(asked["view"]) for asked in crowd.asked}) == views:
        assert time.monotonic() < deadline, "the new view was never asked for"
        page.wait_for_timeout(30)

    # What is no message changes nothing; more tags than points are counts.
    crowd.spoilt = crowd.counted = True
    page.keyboard.press("0")
    page.wait_for_timeout(300)
    assert page.evaluate("skyless.state.many.kind") == "P"
    crowd.spoilt = False
    page.keyboard.press("-")
    until(page, f"{part} === '6\\u202f007 tags, shown as counts: zoom in to see single ones'")
    assert seen(LEFT_M)[3] > 200
    assert seen(RIGHT_M)[3] < 200

    # In 3-D there is only the ordinary stream.
    page.click("#spatial")
    until(page, f"!{part}.includes('counts') || document.getElementById('part').hidden")
