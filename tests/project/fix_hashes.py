"""Hashes of all fixes of fixed seeds and of real recordings, to show that a change of the code changes no result.

    python tests/project/fix_hashes.py --write before.json      (on the code before the change)
    python tests/project/fix_hashes.py --compare before.json    (after it, on the same machine)

The second prints the cases that differ, and its exit code is 1 if there are any.

A hash covers every bit of every fix. It holds for one processor and one set of libraries only: other instruction
sets round differently. Simulated cases need nothing; recordings need the folder of recordings (``SKYLESS_DATA``).
"""

import argparse
import hashlib
import json
import math
import os
import platform
import sys
import tempfile
from itertools import product
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from skyless import METHODS, Request, fleet_of, lab_site
from skyless.cli.main import main as skyless
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.site import AccuracySite
from skyless.sim.evaluation.scenarios import Room
from skyless.sim.lab import paper_lab_site


def _rounding():
    """The start of a hash of functions and linear algebra on fixed numbers: it differs where the instructions do.

    One processor rounds in several ways: CI once ran with ``OPENBLAS_CORETYPE`` set, the hashes' machine without.
    """
    drawn = np.random.default_rng(1).normal(size=(300, 12))
    values = [function(x) for x in drawn[:, 0] for function in (math.sin, math.exp, math.atan)]
    for A, b in ((drawn[:6, :3], drawn[:6, 3]), (drawn[:40, :4], drawn[:40, 4]), (drawn, drawn[:, 0])):
        for part in (A.T @ A, A @ A.T, np.linalg.lstsq(A, b)[0], np.linalg.inv(A.T @ A), np.linalg.svd(A)[1]):
            values.extend(part.ravel())
    return hashlib.sha256(np.array(values).tobytes()).hexdigest()[:8]


MACHINE = f"{platform.machine()}, {' '.join(platform.libc_ver())}, numpy {np.__version__}, rounding {_rounding()}"
"""On what hashes depend."""

SEEDS = (1, 7)
DURATION_S = 6.0
DATA = Path(os.environ.get("SKYLESS_DATA", Path(__file__).parents[2] / "shared" / "data"))
REPLAYS = {
    "bitcraze-packets": (
        "kuipman_tdoa3_sniffer/raw_yaml/b34daf0_output20240415.yaml",
        "--anchors",
        "kuipman_tdoa3_sniffer/anchors.csv",
    ),
    "tdoa-table": (
        "util_flights/const1/const1-trial1-tdoa2_tdoa.csv.gz",
        "--anchors",
        "util_flights/anchors_const1.csv",
        "--truth",
        "util_flights/const1/const1-trial1-tdoa2_pose.csv.gz",
    ),
    "miluv": ("miluv_passive/cirObstaclesOneTag_1_static_0/ifo001/passive_ticks_u32.csv",),
}


def fix_values(judged):
    """Every number of a fix, in a fixed order."""
    fix = judged.fix
    parts = [judged.tag, fix.time_s, fix.position_m, fix.covariance_m2, fix.chi2, fix.residual_rms_m]
    if fix.velocity_mps is not None:
        parts += [fix.velocity_mps, fix.velocity_covariance]
    parts += [fix.hpl_m, fix.vpl_m, fix.anchors]
    return np.concatenate([np.ravel(np.asarray(part, dtype=np.float64)) for part in parts])


def conditions(seed):
    """Simulations: the lab alone; lost and late frames and warm air; errors of a room; anchors at several heights."""
    site = paper_lab_site(accuracy=AccuracySite())
    lifted = tuple(replace(anchor, z_m=2.5 * (index % 2)) for index, anchor in enumerate(site.anchors))
    free = replace(site, anchors=lifted, tags=replace(site.tags, height_m=None))
    yield "lab", Request(site=site, seed=seed, tags=2)
    yield "lossy", Request(site=site, seed=seed, tags=2, loss=0.3, nlos=0.1, diagnostics=True, temperature=True)
    yield "room", Request(site=site, seed=seed, tags=2, room=Room())
    yield "free-height", Request(site=free, seed=seed, tags=1)


def conditions_at_random_instants(seed):
    """The same without a master, for ``joint``."""
    for name, request in conditions(seed):
        yield f"random-instants-{name}", replace(request, site=replace(request.site, schedule=lab_site().schedule))


def simulated(method, condition, seed):
    """Hash, number of fixes and mean position of one simulation."""
    asked = {**dict(conditions(seed)), **dict(conditions_at_random_instants(seed))}
    request = replace(asked[condition], method=method)
    digest, positions = hashlib.sha256(), []
    for judged in fleet_of(request).run(DURATION_S):
        digest.update(fix_values(judged).tobytes())
        positions.append(judged.fix.position_m)
    mean = np.mean(positions, axis=0).tolist() if positions else None
    return {"sha256": digest.hexdigest(), "fixes": len(positions), "mean_m": mean}


def replayed(name):
    """Hash and number of fixes of one recording, from the table that ``skyless replay --fixes-csv`` writes."""
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "fixes.csv"
        places = [str(DATA / part) if "/" in part else part for part in REPLAYS[name]]
        sys.stdout.flush()
        code = skyless(["replay", *places, "--fixes-csv", str(table), "--json"])
        content = table.read_bytes() if code == 0 else b""
    return {"sha256": hashlib.sha256(content).hexdigest(), "fixes": max(content.count(b"\n") - 1, 0)}


def all_cases():
    """Name and function of every case that can run here."""
    for method, seed in product(METHODS, SEEDS):
        for condition, _ in conditions(seed):
            yield f"{method} {condition} {seed}", lambda m=method, c=condition, s=seed: simulated(m, c, s)
    for seed in SEEDS:
        for condition, _ in conditions_at_random_instants(seed):
            yield f"{DEFAULT_METHOD} {condition} {seed}", lambda c=condition, s=seed: simulated(DEFAULT_METHOD, c, s)
    if DATA.is_dir():
        for name in REPLAYS:
            yield f"replay {name}", lambda n=name: replayed(n)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    group = parser.add_mutually_exclusive_group(required=True)
    group.add_argument("--write", type=Path, metavar="FILE")
    group.add_argument("--compare", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    found = {name: run() for name, run in all_cases()}
    if arguments.write is not None:
        arguments.write.write_text(json.dumps({"machine": MACHINE, "cases": found}, indent=1) + "\n")
        return 0
    wanted = json.loads(arguments.compare.read_text())["cases"]
    different = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
    print(f"{len(wanted) - len(different)} of {len(wanted)} cases have the same hash")
    for name in different:
        print(f"differs: {name}: {wanted.get(name)} before, {found.get(name)} now")
    return 1 if different else 0


if __name__ == "__main__":
    sys.exit(main())
