"""How fast a site of 10,000 anchors without a master is simulated, with the positions of its tags.

    python benchmarks/large_site.py [--anchors 10000] [--tags 100] [--seconds 10] [--workers 1 2] [--scheduler ADDRESS]

Prints for each number of workers the wall clock for a second of air, the largest memory of a worker, and a digest of
all fixes: the same for any number of workers, as each makes the same site and simulates some of the tags. With
``--scheduler`` Dask's workers do it instead of processes here: as many as the largest number given, and with this
folder on their PYTHONPATH.
Efficiency is the time of one worker over n times the time of n. The first second of air, with all starts, is not timed.
"""

import argparse
import hashlib
import json
import resource
import time
from functools import lru_cache, partial

import numpy as np
from msgspec.structs import replace

from skyless.core.site import EXACT
from skyless.research.studies.runner import Cell, run_cells, run_cells_on_dask
from skyless.sim.evaluation.cell_fleet import CellFleet
from skyless.sim.evaluation.fleet import FleetSettings
from skyless.sim.impairments import Impairments
from skyless.sim.trajectory import Roaming
from skyless.site.file.template import grid_site

SPACING_M = 15.0
WARM_S = 1.0


@lru_cache(maxsize=1)
def site_of(anchors):
    side_m = round(anchors**0.5) * SPACING_M
    return replace(grid_site(side_m, side_m, SPACING_M, 4.0, 1.0), accuracy=EXACT), side_m


def run_tags(anchors, tags, own, seconds, seed):
    """Some of the tags: digest of the fixes of each, squared errors, seconds of a core and of the wall, memory."""
    site, side_m = site_of(anchors)
    draw = np.random.default_rng(seed)
    middles_m = draw.uniform(50.0, side_m - 50.0, (tags, 2))
    paths = [Roaming((x_m, y_m, 1.0), (6.0, 6.0, 0.0), seed=tag) for tag, (x_m, y_m) in enumerate(middles_m.tolist())]
    fleet = CellFleet(site, paths, Impairments(), seed, FleetSettings(warmup_s=WARM_S), only=own)
    digests = {tag: hashlib.sha256() for tag in own}
    begun = None
    for until_s in (WARM_S, WARM_S + seconds):
        cpu_s, wall_s = time.process_time(), time.perf_counter()
        for judged in fleet.run(until_s):
            digests[judged.tag].update(judged.fix.rows)
        begun = (time.process_time() - cpu_s, time.perf_counter() - wall_s)
    summary = fleet.errors.summary()
    memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return (
        {tag: digest.hexdigest() for tag, digest in digests.items()},
        summary.count * summary.rmse_2d_m**2,
        summary.count,
        *begun,
        memory_mb,
    )


def measure(asked, workers):
    shares = [list(range(first, asked.tags, workers)) for first in range(workers)]
    cells = [
        Cell("tags", partial(run_tags, asked.anchors, asked.tags, own, asked.seconds, asked.seed), 1.0)
        for own in shares
    ]
    if asked.scheduler is None:
        results = run_cells(cells, lambda _: None, workers)
    else:
        results = run_cells_on_dask(cells, lambda _: None, asked.scheduler)
    digests = {tag: digest for result in results for tag, digest in result[0].items()}
    whole = hashlib.sha256("".join(digests[tag] for tag in range(asked.tags)).encode()).hexdigest()
    return {
        "workers": workers,
        "rmse_m": (sum(result[1] for result in results) / sum(result[2] for result in results)) ** 0.5,
        "cpu_s_per_s": sum(result[3] for result in results) / asked.seconds,
        "wall_s_per_s": max(result[4] for result in results) / asked.seconds,
        "memory_mb": max(result[5] for result in results),
        "digest": whole[:16],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--anchors", type=int, default=10_000)
    parser.add_argument("--tags", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scheduler")
    asked = parser.parse_args()
    rows = [measure(asked, workers) for workers in asked.workers]
    for row in rows:
        efficiency = rows[0]["wall_s_per_s"] * rows[0]["workers"] / (row["wall_s_per_s"] * row["workers"])
        print(json.dumps({**row, "efficiency": round(efficiency, 3)}))


if __name__ == "__main__":
    from large_site import main as main_of_module  # so that other processes find them

    main_of_module()
