"""Anchors sorted into square cells of the floor plan, so that those near a point are found without looking at all."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyless.core.arrays import Array, Integers
from skyless.sim.cells._reception import Rules, delivery_chance, pair_key, squared_m2
from skyless.site.kernels import kernel

_MAX_CELLS: Final = 1_000_000
"""Anchors far apart get larger cells instead of more."""


class Grid(NamedTuple):
    """Cells counted from the south-west corner, row by row."""

    west_m: float
    south_m: float
    cell_m: float
    columns: int
    rows: int
    offsets: Integers
    """Shape (cells + 1,): the anchors of a cell are ``anchors[offsets[cell] : offsets[cell + 1]]``."""
    anchors: Integers
    """Indices of the anchors, shape (n,)."""
    cell_of: Integers
    """Cell of each anchor, shape (n,)."""


class Neighbours(NamedTuple):
    """For each anchor, the other anchors that it may receive."""

    offsets: Integers
    """Shape (anchors + 1,)."""
    anchors: Integers
    chance: Array
    """That a frame is strong enough."""
    pair: NDArray[np.uint64]
    """Keys of the pairs' chances."""


def make_grid(positions_m: Array, cell_m: float) -> Grid:
    """Sort anchors, shape (n, 3), n of 1 or more, into cells of about that width, the height left aside."""
    west_m, south_m = positions_m[:, 0].min(), positions_m[:, 1].min()
    width_m, depth_m = positions_m[:, 0].max() - west_m, positions_m[:, 1].max() - south_m
    cell_m = max(cell_m, math.sqrt(width_m * depth_m / _MAX_CELLS), max(width_m, depth_m) / _MAX_CELLS)
    columns, rows = int(width_m / cell_m) + 1, int(depth_m / cell_m) + 1
    column = np.minimum(((positions_m[:, 0] - west_m) / cell_m).astype(np.int64), columns - 1)
    row = np.minimum(((positions_m[:, 1] - south_m) / cell_m).astype(np.int64), rows - 1)
    cell_of = row * columns + column
    offsets = np.concatenate(([0], np.cumsum(np.bincount(cell_of, minlength=columns * rows)))).astype(np.int64)
    anchors = np.argsort(cell_of, kind="stable")
    return Grid(float(west_m), float(south_m), float(cell_m), columns, rows, offsets, anchors, cell_of)


@kernel
def cells_within(grid: Grid, x_m: float, y_m: float, radius_m: float) -> tuple[int, int, int, int]:
    """First and last column and row of the cells that a circle may touch; the last are before the first for none."""
    first = max(math.floor((x_m - radius_m - grid.west_m) / grid.cell_m), 0)
    last = min(math.floor((x_m + radius_m - grid.west_m) / grid.cell_m), grid.columns - 1)
    low = max(math.floor((y_m - radius_m - grid.south_m) / grid.cell_m), 0)
    high = min(math.floor((y_m + radius_m - grid.south_m) / grid.cell_m), grid.rows - 1)
    return first, last, low, high


@kernel
def anchors_within(
    grid: Grid, positions_m: Array, point_m: tuple[float, float, float], radius_m: float, found: Integers
) -> int:
    """Fill ``found``, shape (anchors,), with the anchors at most ``radius_m`` from a point; returns their number."""
    count = 0
    first, last, low, high = cells_within(grid, point_m[0], point_m[1], radius_m)
    for row in range(low, high + 1):
        for column in range(first, last + 1):
            cell = row * grid.columns + column
            for i in range(grid.offsets[cell], grid.offsets[cell + 1]):
                anchor = grid.anchors[i]
                if squared_m2(positions_m, anchor, point_m[0], point_m[1], point_m[2]) <= radius_m * radius_m:
                    found[count] = anchor
                    count += 1
    return count


@kernel
def _list_neighbours(rules: Rules, grid: Grid, positions_m: Array, keys: Integers, lists: Neighbours) -> None:
    """Fill the lists; where they are empty only their offsets."""
    offsets, anchors, chance, pair = lists
    found = np.empty(positions_m.shape[0], dtype=np.int64)
    total = 0
    for one in range(positions_m.shape[0]):
        point_m = (positions_m[one, 0], positions_m[one, 1], positions_m[one, 2])
        for i in range(anchors_within(grid, positions_m, point_m, rules.audible_m, found)):
            if found[i] == one:
                continue
            if anchors.shape[0] > 0:
                anchors[total] = found[i]
                chance[total] = delivery_chance(
                    rules, squared_m2(positions_m, found[i], point_m[0], point_m[1], point_m[2])
                )
                pair[total] = pair_key(rules, keys[one], keys[found[i]])
            total += 1
        offsets[one + 1] = total


def list_neighbours(rules: Rules, grid: Grid, positions_m: Array, keys: Integers) -> Neighbours:
    """For each anchor the others that it may receive; ``positions_m`` has shape (n, 3), ``keys`` (n,)."""
    lists = _empty_lists(np.zeros(len(positions_m) + 1, dtype=np.int64), 0)
    _list_neighbours(rules, grid, positions_m, keys, lists)
    lists = _empty_lists(lists.offsets, int(lists.offsets[-1]))
    _list_neighbours(rules, grid, positions_m, keys, lists)
    return lists


def _empty_lists(offsets: Integers, total: int) -> Neighbours:
    return Neighbours(offsets, np.empty(total, dtype=np.int64), np.empty(total), np.empty(total, dtype=np.uint64))
