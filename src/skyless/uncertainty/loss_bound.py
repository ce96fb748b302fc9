"""Cramér–Rao bounds of a tag that does not hear everything, of a site whose anchors may not either.

The information is what there is on the air at most. What an anchor hears of the reference is known at once, whatever
the tag hears of that anchor, as its next beacon tells its clock, in which all of it is. Other receptions among anchors
are known where the tag has heard the packet itself, without whose stamp they say nothing, and hears the listener before
that has heard a newer one; they are known at once as well, so that no receiver can do better.
"""

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from skyless.kernels.arrays import Array, Mask
from skyless.kernels.compiled import threaded_kernel
from skyless.uncertainty.bounds import (
    DIM,
    RX,
    TX,
    BoundSettings,
    diffuse,
    hear_by_anchor,
    hear_by_tag,
    kernel_settings,
    new_packet,
    predict,
)


def known_receptions(
    draw: Generator, frames: int, anchors: int, *, lost_at_tags: float, lost_at_anchors: float, mesh: bool
) -> Mask:
    """Which receptions of each frame the tag gets to know, shape (frames, anchors + 1); its own are the last column.

    Anchors speak in turn, the reference first.
    """
    senders = np.arange(frames) % anchors
    heard = draw.random((frames, anchors + 1)) >= np.append(np.full(anchors, lost_at_anchors), lost_at_tags)
    own = heard[:, -1]
    told = (1.0 - lost_at_tags) / max(1.0 - lost_at_tags * lost_at_anchors, 1e-12)
    relayed = draw.random((frames, anchors)) < told
    others = relayed & own[:, None] if mesh else np.zeros_like(relayed)
    others[senders == 0] = True
    heard[:, :-1] &= others
    heard[np.arange(frames), senders] = False
    return heard


def received_bound(anchors_m: ArrayLike, path_m: ArrayLike, settings: BoundSettings, known: Mask) -> Array:
    """Posterior bound of the position after every frame, shape (frames, dims, dims), in m².

    ``anchors_m``: shape (n, 3), in the order of their slots, the reference first. ``path_m``: where the tag is at each
    frame, shape (frames, 3). ``known``: as of ``known_receptions``, shape (frames, n + 1); it, not the settings, says
    what of the mesh is known.

    Raises:
        ValueError: there is not one row of ``known`` for each place.
    """
    anchors = np.ascontiguousarray(anchors_m, np.float64)
    path = np.ascontiguousarray(path_m, np.float64)
    if known.shape != (len(path), len(anchors) + 1):
        raise ValueError(f"known has shape {known.shape}; it should be {(len(path), len(anchors) + 1)}")
    array = kernel_settings(settings)
    dims = int(array[DIM])
    size = 2 * dims + 2 * len(anchors) + 1
    bound = np.empty((len(path), dims, dims))
    P = diffuse(size, dims, settings.speed_std_mps)
    _run_received(anchors, path, settings.slot_s, array, known, P, np.empty(size), np.empty(size), bound)
    return bound


@threaded_kernel
def _run_received(
    anchors: Array,
    path: Array,
    slot_s: float,
    settings: Array,
    known: Mask,
    P: Array,
    h: Array,
    ph: Array,
    bound: Array,
) -> None:
    n, dims = len(anchors), int(settings[DIM])
    for frame in range(len(path)):
        sender = frame % n
        if frame > 0:
            predict(P, dims, n, slot_s, settings)
        new_packet(P, settings[TX])
        if known[frame, n]:
            hear_by_tag(P, h, ph, anchors, sender, path[frame], dims, settings[RX])
        for listener in range(n):
            if known[frame, listener]:
                hear_by_anchor(P, h, ph, sender, listener, dims, settings[RX])
        bound[frame] = P[:dims, :dims]
