"""What Foxglove's own client receives of a site, from above.

    timeout 15 node tests/clients/foxglove_client.cjs .venv-clients/foxglove ws://127.0.0.1:8765 foxglove.sdk.v1 |
        python docs/pictures/foxglove_scene.py docs/pictures/foxglove.svg

``scripts/test clients foxglove`` installs the client.
"""

import json
import math
import sys
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Rectangle

matplotlib.rcParams["svg.fonttype"] = "none"
matplotlib.rcParams["svg.hashsalt"] = "skyless"
TAG_COLOURS = ("#0072b2", "#009e73", "#cc79a7")


def main(out: str) -> None:
    """Read the client's lines, and draw what they hold."""
    lines = [json.loads(line) for line in sys.stdin]
    messages = [line for line in lines if line["event"] == "message"]
    figure = Figure(figsize=(8.4, 4.6), facecolor="white")
    axes = figure.add_axes((0.06, 0.1, 0.42, 0.82))
    axes.set_aspect("equal")
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("x of frame “site” in m")
    axes.set_ylabel("y in m")
    for entity in [m for m in messages if m["topic"] == "/site/scene"][-1]["value"]["entities"]:
        for cube in entity["cubes"]:
            _cube(axes, cube)
        for text in entity["texts"]:
            where = text["pose"]["position"]
            axes.annotate(text["text"], (where["x"], where["y"]), xytext=(4, 6), textcoords="offset points", fontsize=9)
    tags = sorted({m["topic"].split("/")[2] for m in messages if m["topic"].endswith("/pose")})
    for tag, colour in zip(tags, TAG_COLOURS, strict=False):
        track = [m["value"]["pose"]["position"] for m in messages if m["topic"] == f"/tag/{tag}/pose"]
        axes.plot([p["x"] for p in track], [p["y"] for p in track], color=colour, linewidth=1.2)
        entity = [m for m in messages if m["topic"] == f"/tag/{tag}/ellipse"][-1]["value"]["entities"][0]
        disc, where = entity["spheres"][0], entity["texts"][0]["pose"]["position"]
        turned = 2.0 * math.atan2(disc["pose"]["orientation"]["z"], disc["pose"]["orientation"]["w"])
        size = (disc["size"]["x"], disc["size"]["y"])
        axes.add_patch(Ellipse((where["x"], where["y"]), *size, angle=math.degrees(turned), color=colour, alpha=0.5))
        label = {"xytext": (6, -12), "textcoords": "offset points", "color": colour, "fontsize": 10}
        axes.annotate(entity["texts"][0]["text"], (where["x"], where["y"]), **label)
    axes.margins(0.08)
    axes.autoscale_view()
    _table(figure, lines, messages)
    figure.savefig(out, metadata={"Date": None})


def _cube(axes: Axes, cube: dict[str, Any]) -> None:
    where, size, colour = cube["pose"]["position"], cube["size"], cube["color"]
    corner = (where["x"] - size["x"] / 2, where["y"] - size["y"] / 2)
    shown = tuple(colour[part] for part in "rgba")
    turned = 2.0 * math.degrees(math.atan2(cube["pose"]["orientation"]["z"], cube["pose"]["orientation"]["w"]))
    middle = (where["x"], where["y"])
    axes.add_patch(Rectangle(corner, size["x"], size["y"], angle=turned, rotation_point=middle, color=shown))


def _table(figure: Figure, lines: list[dict[str, Any]], messages: list[dict[str, Any]]) -> None:
    """Every channel, its schema and how many messages came."""
    channels = {line["topic"]: line["schema"] for line in lines if line["event"] == "channel"}
    stamps = [int(message["ns"]) for message in messages]
    seconds = (max(stamps) - min(stamps)) / 1e9
    figure.text(0.52, 0.9, f"channels, and messages in {seconds:.0f} s", fontsize=10, weight="bold")
    for row, (topic, schema) in enumerate(sorted(channels.items())):
        y = 0.84 - 0.06 * row
        count = sum(message["topic"] == topic for message in messages)
        figure.text(0.52, y, topic, fontsize=9, family="monospace")
        figure.text(0.74, y, schema, fontsize=9)
        figure.text(0.99, y, str(count), fontsize=9, ha="right")


if __name__ == "__main__":
    main(sys.argv[1])
