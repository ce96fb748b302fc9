"""The pictures of the documents, made again: ``.venv/bin/python docs/pictures/make.py``.

Numbers come from the tables of the documents, the rooms from ``pyproject.toml``, the lab from its site file, so
that a picture never says something else than the text. The SVGs are part of the repository.

``.venv/bin/python docs/pictures/make.py page`` records the page's animation for the README (``page.py``): the demo in
Debian's Chromium, for half a minute, on a machine that has nothing else to do.
"""

import re
import sys
import tomllib
import zlib
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle

from skyless.core.air.frame import air_time_s
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.report import BLUE, GREEN, GRID, INK, MUTED, ORANGE

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
SOFT_BLUE, SOFT_GREEN, SOFT_ORANGE, SOFT = "#e3eef8", "#e0f2ec", "#fbebdc", "#f2f4f7"


def table_rows(document: str, heading: str) -> list[list[str]]:
    """Rows of the first table that follows a heading, emphasis removed."""
    text = (ROOT / document).read_text(encoding="utf-8").split(f"\n{heading}\n")[1]
    rows = []
    for line in text.splitlines():
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.replace("**", "").strip("|").split("|")])
        elif rows:
            break
    return rows


def numbers(cell: str) -> list[float]:
    """The values of a cell, what stands behind ± left out."""
    return [float(number) for number in re.findall(r"(?<![\d.])\d*\.?\d+", re.sub(r"±\s*[\d.]+", "", cell))]


def axes_of(width: float, height: float, *, bare: bool = False) -> tuple[Figure, Axes]:
    """A figure with one pair of axes, sizes in inches."""
    figure = Figure(figsize=(width, height), facecolor="white")
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98)) if bare else figure.add_subplot()
    if bare:
        axes.set_axis_off()
    else:
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_axisbelow(True)
        axes.tick_params(colors=INK, labelsize=9)
    return figure, axes


def box(axes: Axes, x: float, y: float, width: float, height: float, text: str, colour: str, size: float = 9) -> None:
    """A box with centred text; the first line is bold where there are more."""
    axes.add_patch(FancyBboxPatch((x, y), width, height, "round,pad=0,rounding_size=0.06", fc=colour, ec=MUTED, lw=0.8))
    head, _, rest = text.partition("\n")
    lines = rest.count("\n") + 1 if rest else 0
    centre, step = y + height / 2, size * 0.0195
    axes.text(x + width / 2, centre + step * lines / 2, head, ha="center", va="center", size=size, color=INK,
              weight="bold" if rest else "normal")  # fmt: skip
    if rest:
        axes.text(x + width / 2, centre - step * 0.55, rest, ha="center", va="center", size=size - 1, color=INK,
                  linespacing=1.25)  # fmt: skip


def arrow(axes: Axes, begin: tuple[float, float], end: tuple[float, float], text: str = "") -> None:
    """An arrow with a text next to its middle."""
    axes.annotate("", end, begin, arrowprops={"arrowstyle": "-|>", "color": MUTED, "lw": 1.2})
    if text:
        middle = ((begin[0] + end[0]) / 2 + 0.06, (begin[1] + end[1]) / 2)
        axes.text(*middle, text, size=8, color=MUTED, va="center")


def lab() -> Figure:
    """The lab's anchors and the two positions of the tables."""
    figure, axes = axes_of(3.6, 4.2)
    axes.add_patch(Rectangle((0, 0), 6, 8, fc=SOFT, ec=MUTED))
    for number, anchor in enumerate(lab_site().anchors, 1):
        axes.plot(anchor.x_m, anchor.y_m, "^", color=BLUE, ms=10, clip_on=False)
        inwards = 1 if anchor.x_m < 3 else -1
        axes.annotate(str(number), (anchor.x_m, anchor.y_m), (9 * inwards, 5),
                      textcoords="offset points", ha="left" if inwards > 0 else "right", size=9, color=INK)  # fmt: skip
    for x, y in ((3.0, 4.0), (1.2, 1.6)):
        axes.plot(x, y, "x", color=GREEN, ms=8, mew=2)
        axes.annotate(f"({x:g}, {y:g})", (x, y), (8, -3), textcoords="offset points", size=9, color=GREEN)
    axes.set(xlabel="x, m", ylabel="y, m", xlim=(-0.4, 6.4), ylim=(-0.4, 8.4), aspect="equal")
    axes.spines[:].set_visible(False)
    figure.tight_layout()
    return figure


def superframe() -> Figure:
    """Two superframes of the lab: who is on the air when."""
    schedule = paper_lab_site().schedule
    slot_ms, slots = schedule.slot_s * 1e3, 6
    frame_ms = air_time_s(100) * 1e3
    figure, axes = axes_of(7.2, 2.5)
    for anchor in range(slots):
        for repeat in range(2):
            begin = (repeat * slots + anchor) * slot_ms
            colour = ORANGE if anchor == 0 else BLUE
            axes.add_patch(Rectangle((begin, -anchor - 0.32), slot_ms, 0.64, fc=SOFT, ec=GRID))
            axes.add_patch(Rectangle((begin, -anchor - 0.32), frame_ms, 0.64, fc=colour, ec="none"))
    axes.axvline(slots * slot_ms, color=MUTED, lw=0.9, ls=":")
    axes.text(slots * slot_ms / 2, 0.62, f"superframe n, {slots * slot_ms:g} ms", ha="center", size=9, color=INK)
    axes.text(slots * slot_ms * 1.5, 0.62, "superframe n + 1", ha="center", size=9, color=INK)
    axes.set(xlim=(-0.2, 2 * slots * slot_ms), ylim=(-slots + 0.4, 1.2), xlabel="time, ms")
    axes.set_yticks([-anchor for anchor in range(slots)], ["1, master", *map(str, range(2, slots + 1))])
    axes.set_ylabel("anchor")
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="y", length=0)
    figure.tight_layout()
    return figure


def room_study() -> Figure:
    """RMSE, predicted σ and bound of the cases of the room."""
    chosen = re.compile(
        r"the room|unbiased|hall|3-D room,|stairwell|at rest.*later|one anchor 20|two anchors|multi|past|a body"
        r"|[23] of 6 late, 0.5–2 m$|all anchors"
    )
    points: list[tuple[str, float, float, float | None]] = []
    for row in table_rows("docs/studies.md", "## Results in the room")[2:]:
        if chosen.match(row[0]):
            bounds = numbers(row[5])
            points.append((row[0], numbers(row[1])[0], numbers(row[3])[0], bounds[0] if bounds else None))
    assert len(points) == 19, points
    figure, axes = axes_of(7.2, 5.4)
    heights = [-place for place in range(len(points))]
    for height, (_, error, sigma, _bound) in zip(heights, points, strict=True):
        axes.plot([error, sigma], [height, height], color=GRID, lw=3, zorder=1)
    axes.plot([point[1] for point in points], heights, "o", color=BLUE, ms=7, label="RMSE")
    axes.plot([point[2] for point in points], heights, "D", color=ORANGE, ms=5, label="predicted σ")
    bounded = [(point[3], height) for point, height in zip(points, heights, strict=True) if point[3] is not None]
    axes.plot(*zip(*bounded, strict=True), "|", color=INK, ms=13, mew=2.2, label="bound", ls="none")
    axes.set_yticks(heights, [point[0] for point in points])
    axes.set(xlabel="cm (simulated)", xscale="log", xlim=(1.2, 150))
    axes.set_xticks([2, 5, 10, 20, 50, 100], ["2", "5", "10", "20", "50", "100"])
    axes.minorticks_off()
    axes.grid(axis="x", color=GRID, lw=0.7)
    axes.tick_params(axis="y", length=0)
    axes.legend(loc="upper right", frameon=False, fontsize=9)
    figure.tight_layout()
    return figure


def replayed_flights() -> Figure:
    """3-D errors of recorded flights, with a gate alone and with the estimator."""
    points: list[tuple[str, float, float]] = []
    for name, gate, replay in table_rows("docs/recordings.md", "## What fixes from time differences are worth")[2:]:
        if name.startswith("MILUV"):
            continue
        alone, ours = numbers(gate)[1::2], numbers(replay)[1::2]
        label = re.sub(r" \(.*\)", "", name)
        head, _, tail = label.partition(" trial")
        if len(alone) > 1 and tail:
            listed, _, kind = tail.removeprefix("s ").rpartition(", TDoA")
            trials = (listed or tail.removeprefix("s ")).split(", ")
            labels = [f"{head} trial {trial}{f', TDoA{kind}' if listed else ''}" for trial in trials]
        else:
            labels = [f"0425 {part}" for part in label.removeprefix("0425 ").split(", ")] if len(alone) > 1 else [label]
        points += zip(labels, alone, ours, strict=True)
    assert len(points) == 20, points
    figure, axes = axes_of(7.2, 4.6)
    for place, (_, alone_m, ours_m) in enumerate(points):
        axes.plot([100 * alone_m, 100 * ours_m], [-place, -place], color=GRID, lw=3, zorder=1)
    heights = [-place for place in range(len(points))]
    axes.plot([100 * point[1] for point in points], heights, "o", color=MUTED, ms=6, label="gate alone")
    axes.plot([100 * point[2] for point in points], heights, "o", color=BLUE, ms=7, label="skyless replay")
    axes.set_yticks(heights, [point[0] for point in points])
    axes.set(xlabel="RMSE 3-D, cm (recorded)", xlim=(0, 46))
    axes.grid(axis="x", color=GRID, lw=0.7)
    axes.tick_params(axis="y", length=0)
    axes.legend(loc="upper right", frameon=False, fontsize=9)
    figure.tight_layout()
    return figure


def layers() -> Figure:
    """The rooms of the code, each importing only those below it, as the contract in ``pyproject.toml`` has them."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    rows = [line.replace("skyless.", "").split(" | ") for line in reversed(contracts[0]["layers"])]
    figure, axes = axes_of(7.2, 0.5 * len(rows) + 0.2, bare=True)
    axes.set(xlim=(0, 10), ylim=(0, len(rows)))
    for number, names in enumerate(rows):
        colour = SOFT_GREEN if number == 0 else SOFT_BLUE if number < 3 else SOFT_ORANGE
        width = 9.5 / len(names)
        for place, name in enumerate(names):
            box(axes, 0.5 + place * width + 0.04, number + 0.1, width - 0.08, 0.8, name, colour, 11)
    axes.annotate("", (0.2, 0.1), (0.2, len(rows) - 0.1), arrowprops={"arrowstyle": "-|>", "color": MUTED, "lw": 1.2})
    return figure


STAGES: Sequence[tuple[str, str, str]] = (
    ("radio", "frame of a beacon, RX stamp, diagnostics", SOFT_ORANGE),
    ("Receiver.hear", "one compiled call; pages, starts and moved anchors come back to it", SOFT_BLUE),
    ("hearing", "read the frame, unwrap the stamps, which anchors are confirmed", SOFT_BLUE),
    ("course", "process the packet, or begin again", SOFT_BLUE),
    ("estimator", "time update · own reception · relays · report · faults · levels", SOFT_BLUE),
    ("Fix", "position, velocity, covariance, protection level, alert", SOFT_GREEN),
    ("outputs", "MQTT, page, recording, CSV", SOFT_ORANGE),
)


def beacon_to_fix() -> Figure:
    """A beacon's way from the radio to a fix."""
    figure, axes = axes_of(7.2, 4.4, bare=True)
    top = len(STAGES)
    axes.set(xlim=(0, 10), ylim=(0, top))
    for number, (name, what, colour) in enumerate(STAGES):
        y = top - 1 - number
        box(axes, 0.2, y + 0.2, 2.6, 0.6, name, colour, 10)
        axes.text(3.1, y + 0.5, what, size=9.5, color=INK, va="center")
        if number + 1 < top:
            arrow(axes, (1.5, y + 0.2), (1.5, y - 0.2))
    return figure


def signed() -> Figure:
    """How a beacon is verified: its code at once, the key of that code later, and the signature of the key's chain."""
    figure, axes = axes_of(4.4, 2.6, bare=True)
    axes.set(xlim=(0, 10), ylim=(0, 6))
    box(axes, 0.3, 3.4, 4.2, 2.0, "beacon\nstamp, position, code", SOFT_BLUE, 11)
    box(axes, 5.5, 3.4, 4.2, 2.0, "key of its 100 ms\nsent half a second later", SOFT_ORANGE, 11)
    box(axes, 2.6, 0.4, 5.0, 1.8, "the site signed the chain\na tag holds site.public", SOFT_GREEN, 11)
    arrow(axes, (5.4, 4.4), (4.6, 4.4))
    arrow(axes, (5.1, 2.3), (6.8, 3.3))
    return figure


PICTURES: dict[str, Callable[[], Figure]] = {
    "lab": lab,
    "superframe": superframe,
    "room_study": room_study,
    "replayed_flights": replayed_flights,
    "layers": layers,
    "beacon_to_fix": beacon_to_fix,
    "signed": signed,
}


def content_of(figure: Figure) -> str:
    """A checksum of the numbers and texts in a picture; it stands in the SVG, and a test compares it."""
    texts = [text.get_text() for axes in figure.axes for text in axes.texts]
    lines = [line.get_xydata().round(6).tolist() for axes in figure.axes for line in axes.lines]
    return f"{zlib.crc32(repr((texts, lines)).encode()):08x}"


def main(names: Iterable[str]) -> None:
    """Write the pictures of these names, or all but the animation ``page``."""
    matplotlib.rcParams.update({"svg.hashsalt": "skyless", "font.family": "DejaVu Sans"})
    for name in names or PICTURES:
        if name == "page":
            import page

            page.record()
            continue
        figure = PICTURES[name]()
        figure.savefig(FOLDER / f"{name}.svg", metadata={"Date": None, "Description": content_of(figure)})


if __name__ == "__main__":
    main(sys.argv[1:])
