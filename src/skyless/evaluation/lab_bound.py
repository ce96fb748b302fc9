"""The Cramér–Rao bound of a walking tag in the lab, over random paths (``docs/maths.md`` section 5)."""

from concurrent.futures import ThreadPoolExecutor
from typing import Final

import numpy as np
from numpy.random import Generator

from skyless.kernels.arrays import Array
from skyless.kernels.compiled import cores
from skyless.site.lab import ideal_lab_site
from skyless.uncertainty.bounds import bound_settings, tracking_bound

SUPERFRAMES: Final = 134
"""Two seconds, after which nothing of what was known before the first frame is left."""
LAST: Final = 20
"""The bound is averaged over so many superframes at the end."""
SPEED_STD_MPS: Final = 0.4
WHITE_FM: Final = 2e-11


def lab_tracking_bound_m(
    stamp_s: float,
    *,
    random_walk_fm: float = 1e-9,
    qa: float = 0.5,
    mesh: bool = False,
    paths: int = 400,
    seed: int = 1,
) -> float:
    """Root mean square of the posterior bound of the position in the lab, in metres.

    Tags start in the middle half of the room, each component of their velocity normal with 0.4 m/s, and accelerate
    at random (``qa``). ``mesh``: anchors also relay when they heard each other.
    """
    site = ideal_lab_site()
    anchors = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors])
    slot_s = site.schedule.slot_s
    settings = bound_settings(
        stamp_s,
        white_fm=WHITE_FM,
        random_walk_fm=random_walk_fm,
        qa=qa,
        slot_s=slot_s,
        speed_std_mps=SPEED_STD_MPS,
        mesh=mesh,
    )
    low, high = anchors[:, :2].min(axis=0), anchors[:, :2].max(axis=0)
    middle, half = (low + high) / 2.0, (high - low) / 4.0
    draw = np.random.default_rng(seed)
    walks = [random_path(draw, middle, half, slot_s, SUPERFRAMES * len(anchors), qa) for _ in range(paths)]

    def variance(path: Array) -> float:
        return float(np.trace(tracking_bound(anchors, path, settings)[-LAST:], axis1=1, axis2=2).mean())

    with ThreadPoolExecutor(cores()) as pool:
        return float(np.sqrt(np.mean(list(pool.map(variance, walks)))))


def random_path(draw: Generator, middle: Array, half: Array, step_s: float, steps: int, qa: float) -> Array:
    """Places every ``step_s`` of a tag with random acceleration, shape (steps, 3), at height 0."""
    start, velocity = draw.uniform(middle - half, middle + half), draw.normal(0.0, SPEED_STD_MPS, 2)
    kicks = draw.normal(size=(2, steps - 1, 2)) * np.sqrt(qa * step_s)
    velocities = velocity + np.vstack([np.zeros(2), np.cumsum(kicks[0], axis=0)])
    moves = step_s * (velocities[:-1] + kicks[0] / 2.0 + kicks[1] / np.sqrt(12.0))
    path = np.zeros((steps, 3))
    path[:, :2] = start + np.vstack([np.zeros(2), np.cumsum(moves, axis=0)])
    return path
