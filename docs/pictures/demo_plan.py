"""Draws the floor plan of the demo's workshop: python docs/pictures/demo_plan.py."""

from pathlib import Path

import matplotlib as mpl

mpl.use("agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Arc, Rectangle

FILE = Path(__file__).parents[2] / "src" / "skyless" / "cli" / "nodes" / "demo_plan.png"
INK, FILL = "#64748b", "#94a3b833"
WIDTH_M, DEPTH_M = 6.0, 8.0


def draw() -> None:
    """Walls, a door, benches, shelves and the robot's base, on a transparent ground for both themes of the page."""
    figure = plt.figure(figsize=(WIDTH_M, DEPTH_M), dpi=120)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, WIDTH_M), ylim=(0.0, DEPTH_M))
    axes.axis("off")
    walls_x_m, walls_y_m = (2.4, 5.96, 5.96, 0.04, 0.04, 1.4), (0.04, 0.04, 7.96, 7.96, 0.04, 0.04)  # but for the door
    axes.plot(walls_x_m, walls_y_m, color=INK, linewidth=6)
    for x, y, width, depth in (
        (0.15, 5.5, 0.5, 2.1), (1.0, 7.35, 1.6, 0.5),  # shelves of goods in
        (3.3, 7.35, 2.5, 0.5), (5.35, 4.4, 0.5, 2.4),  # benches
        (2.2, 3.4, 1.6, 1.2),  # the table in the middle
        (0.15, 0.3, 0.5, 2.0),  # cupboards
    ):  # fmt: skip
        axes.add_patch(Rectangle((x, y), width, depth, facecolor=FILL, edgecolor=INK, linewidth=1.5))
        axes.plot((x, x + width), (y, y + depth), color=INK, linewidth=0.6)
    for radius in (0.25, 0.5):
        axes.add_patch(plt.Circle((4.7, 1.5), radius, facecolor=FILL, edgecolor=INK, linewidth=1.5))
    axes.plot((1.4, 1.4), (0.0, 1.0), color=INK, linewidth=2)
    axes.add_patch(Arc((1.4, 0.0), 2.0, 2.0, theta1=0.0, theta2=90.0, color=INK, linewidth=1.0))
    figure.savefig(FILE, transparent=True)


if __name__ == "__main__":
    draw()
