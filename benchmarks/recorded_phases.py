"""What phases of the carrier give on the recording of MULoc: the figures of docs/phases.md.

    python benchmarks/recorded_phases.py FOLDER/location1_2.npz [SHARE SEED]

With a share of the packets, drawn at random. Per channel, by stamps alone and with phases: errors at the stops, over
the whole way and from 0.8 m on; shape (the stops' mean errors less their mean); NEES for each dimension; fixes beyond
their level; speed at rest from half a second, and how far places over 0.2 s scatter within a stop, both without the
first and last one.
"""

import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from skyless.core.arrays import Array
from skyless.core.ticks import CARRIER_CYCLES
from skyless.research.foreign import datasets as muloc
from skyless.run.masterless.packet_tracking import MASTERLESS, PacketTracking

MARGINS_S: Final = (0.3, 0.4)
"""Of each stop, at its begin and its end: the tag is still moving."""
WALKED_STOPS: Final = 2
"""Stops before 0.8 m have been walked."""


def tracked(path: Path, channel: int, share: float = 1.0, seed: int = 0, *, has_phases: bool) -> Array:
    """Time, position and covariance in two dimensions, and level, shape (fixes, 8)."""
    draw = np.random.default_rng(seed)
    settings = MASTERLESS.changed(carrier_cycles=CARRIER_CYCLES[channel] if has_phases else 0, height_m=0.0)
    tracking, rows = PacketTracking(settings, muloc.muloc_anchors(path), 40), []
    with path.open("rb") as stream:
        for packet in muloc.read_muloc(stream, Counter(), channel):
            if draw.random() < share and (fix := tracking.on_packet(packet)) is not None:
                level_m = np.nan if fix.hpl_m is None else fix.hpl_m
                rows.append((fix.time_s, *fix.position_m[:2], *fix.covariance_m2[:2, :2].ravel(), level_m))
    return np.array(rows)


def stops_of(path: Path) -> list[tuple[float, float, Array]]:
    """Begin, end and place of each stop."""
    truth = muloc.muloc_truth(path, None)
    assert truth is not None
    begins = np.sort(np.unique(truth.position_m[:, :2], axis=0, return_index=True)[1]).tolist()
    return [
        (truth.t_s[begin], truth.t_s[end - 1], truth.position_m[begin, :2])
        for begin, end in pairwise([*begins, len(truth.t_s)])
    ]


def rms(errors: Array) -> float:
    """Root mean square of vectors."""
    return float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1))))


def figures(rows: Array, stops: list[tuple[float, float, Array]]) -> str:
    """One line of figures."""
    errors, nees, beyond, speeds, places = [], [], [], [], []
    for number, (begin_s, end_s, place_m) in enumerate(stops):
        own = rows[(rows[:, 0] >= begin_s + MARGINS_S[0]) & (rows[:, 0] <= end_s - MARGINS_S[1])]
        off_m, covariances = own[:, 1:3] - place_m, own[:, 3:7].reshape(-1, 2, 2)
        errors.append(off_m)
        nees.append(np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(covariances), off_m) / 2.0)
        beyond.append(np.hypot(*off_m.T) > own[:, 7])
        if 0 < number < len(stops) - 1:
            times_s = own[:, 0] - own[0, 0]
            for start_s in np.arange(0.0, times_s[-1] - 0.5, 0.1):
                part = (times_s >= start_s) & (times_s <= start_s + 0.5)
                speeds.append(np.polyfit(times_s[part], own[part, 1:3], 1)[0])
            step = (times_s / 0.2).astype(int)
            means = np.array([own[step == one, 1:3].mean(axis=0) for one in np.unique(step)])
            places.append(means - means.mean(axis=0))
    shape = np.array([one.mean(axis=0) for one in errors])
    late_m, shape_m = rms(np.concatenate(errors[WALKED_STOPS:])), rms(shape - shape.mean(axis=0))
    speed_mps, place_m = rms(np.array(speeds)), rms(np.concatenate(places))
    return (
        f"whole way {100 * rms(np.concatenate(errors)):5.1f} cm, from 0.8 m on "
        f"{100 * late_m:5.1f} cm, shape {100 * shape_m:5.1f} cm, "
        f"NEES {np.concatenate(nees).mean():.2f}, beyond levels {np.concatenate(beyond).mean():.4f}, "
        f"speed at rest {1e3 * speed_mps:.1f} mm/s, place at rest {1e3 * place_m:.1f} mm"
    )


def main() -> None:
    """Print two lines for each channel."""
    path, share, seed = (*sys.argv[1:], 1.0, 0)[:3]
    stops = stops_of(Path(path))
    for channel in muloc.CHANNELS:
        for has_phases in (False, True):
            name = "with phases " if has_phases else "stamps alone"
            found = figures(tracked(Path(path), channel, float(share), int(seed), has_phases=has_phases), stops)
            print(f"channel {channel}, {name}: {found}", flush=True)


if __name__ == "__main__":
    main()
