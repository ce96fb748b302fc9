"""How fast filters, frames, replays and Monte Carlo draws are on this machine, from simulated messages.

    python benchmarks/speed.py [--quick] [--json]

Figures of one core are medians of several short runs in the time of the thread, so that other work on the machine
disturbs little. docs/speed.md says what each key of the JSON is.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

sys.path.extend(str(Path(__file__).parents[1] / "tests" / folder) for folder in (".", "core"))

import numpy as np
from estimator_builders import Case, begun, episode_of, one_by_one, settings_of
from pseudoranges import located
from scipy.optimize import least_squares
from textbook_filter import TextbookFilter

from skyless.core.any_receiver import AnyReceiver
from skyless.core.estimator.estimator import Packets
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.method_names import SNAPSHOTS
from skyless.core.protocol1.beacon import decode, decode_cached, encode
from skyless.core.tag.receiver import Receiver
from skyless.machine import cores
from skyless.research.paper.plan import draw_moments
from skyless.research.replays.captures import CaptureReplay
from skyless.research.replays.options import ReplayOptions
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.trajectory import Static
from support import synthetic_recordings as synthetic
from support.random_chain import draw_loop, random_chain

NODES, SLOT_S, WARM_S = 7, 2.1e-3, 2.0
ANGLES = 2.0 * np.pi * np.arange(NODES) / NODES
ANCHORS_M = np.column_stack([3.0 + 4.0 * np.cos(ANGLES), 4.0 + 5.0 * np.sin(ANGLES), np.zeros(NODES)])
EXACT = ("survey_std_m", "range_std_m", "slope_std_m", "place_std_m")
CHUNK, CHUNKS, TAGS = 10 * NODES, 64, (1, 100, 10_000)
REPLAYED = {"tdoa-table": 10.0, "miluv": 2.0, "avalue": 1.0}
"""How many times as many rows as of the other formats."""


def seconds(prepare, runs):
    """Median of several runs of what is prepared, after one that is not counted."""
    prepare()()
    times = []
    for _ in range(runs):
        run, start_s = prepare(), time.thread_time()
        run()
        times.append(time.thread_time() - start_s)
    return statistics.median(times)


@contextmanager
def one_core():
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    yield
    os.sched_setaffinity(0, before)


def episode(superframes, *, mesh):
    at_rest_m = np.broadcast_to([3.0, 4.0, 0.0], (superframes * NODES, 3))
    return episode_of(Case(mesh=mesh), superframes, 1, ANCHORS_M, path_m=at_rest_m, slot_s=SLOT_S)


def kernel(quick, *, mesh, exact):
    """Messages a second of the estimator in batch, and of a textbook's filter in NumPy with the same messages."""
    made, few = episode(120 if quick else 1000, mesh=mesh), 42 if quick else 280
    usual = {} if exact else {name: getattr(EstimatorSettings(), name) for name in EXACT}
    settings, packets = settings_of(Case(mesh=mesh), 0.0, **usual), made.packets
    start = np.array([3.0, 4.0]), 0.09 * np.eye(2), 0.16
    rows = list(one_by_one(packets))[:few]

    def textbook():
        plain = TextbookFilter(settings, ANCHORS_M, int(packets.rx_ticks[0]), *start)
        return lambda: [plain.update(row, 1.0, 1.0, {}) for row in rows]

    own = len(packets.anchors) / seconds(
        lambda: partial(begun(made, settings, ANCHORS_M).track, packets), 3 if quick else 9
    )
    plain = few / seconds(textbook, 3)
    return {"messages_per_s": own, "ratio": own / plain, "numpy_messages_per_s": plain}


def messages(quick):
    """Cost of a beacon's frame and of a receiver from bytes to fix, by protocol 2, and by each method of protocol 1."""
    until_s, found = WARM_S + (3.0 if quick else 8.0), {}
    for site, receivers in (
        (lab_site(), {"joint": Receiver}),
        (paper_lab_site(), {name: partial(AnyReceiver, name) for name in SNAPSHOTS}),
    ):
        world = world_of(site, [Static(3.0, 4.0)], lab_impairments(100.0), 1)
        heard = [reception for sent in world.run(until_s) for _, reception, _ in sent.receptions()]
        warm = round(len(heard) * WARM_S / until_s)

        def hear(make, heard=heard, warm=warm):
            receiver = make()
            for reception in heard[:warm]:
                receiver.hear(reception)
            decode_cached.cache_clear()
            return lambda: [receiver.hear(reception) for reception in heard[warm:]]

        found |= {name: seconds(partial(hear, make), 3) / (len(heard) - warm) for name, make in receivers.items()}
    beacons = [decode(reception.frame) for reception in heard[-240:]]
    frames = {
        "encode_s": seconds(lambda: lambda: [encode(one) for one in beacons], 9) / len(beacons),
        "decode_s": seconds(lambda: lambda: [decode(one.frame) for one in heard[-240:]], 9) / len(beacons),
    }
    return {"seconds_per_message": found["joint"], "by_method": found, **frames}


def snapshots(quick):
    """Positions a second from seven pseudoranges, without a guess; of SciPy from the middle of the anchors."""
    ranges_m = np.linalg.norm(ANCHORS_M - [3.5, 3.0, 0.0], axis=1)
    rows = ranges_m + np.random.default_rng(2).normal(0.0, 0.042, (6 if quick else 40, NODES))
    middle, variances = np.append(ANCHORS_M[:, :2].mean(axis=0), 0.0), np.full(NODES, 2e-3)

    def residuals(unknown, row):
        return np.hypot(*(ANCHORS_M[:, :2] - unknown[:2]).T) + unknown[2] - row

    own = partial(map, lambda row: located(ANCHORS_M, row, variances, height_m=0.0), rows)
    scipys = partial(map, lambda row: least_squares(residuals, middle, method="lm", args=(row,)), rows)
    ours, other = (len(rows) / seconds(lambda each=each: lambda: list(each()), 3) for each in (own, scipys))
    return {"fixes_per_s": ours, "scipy_fixes_per_s": other, "ratio": ours / other}


def many_tags(quick):
    """Nanoseconds of a message with many tags in one process, and messages a second on all cores."""
    made, settings, by_tags = episode(CHUNK // NODES * CHUNKS, mesh=False), settings_of(Case(mesh=False)), {}
    p = made.packets
    ends = [int(p.ends[k * CHUNK - 1]) if k else 0 for k in range(CHUNKS + 1)]
    parts = []
    for k in range(CHUNKS):
        rows = slice(k * CHUNK, (k + 1) * CHUNK)
        columns = (p.anchors[rows], p.sequences[rows], p.rx_ticks[rows], p.tx_ticks[rows])
        parts.append(Packets(*columns, p.relays[ends[k] : ends[k + 1]], p.ends[rows] - ends[k]))

    def track(tags, chunk):
        for tag in tags:
            tag.track(parts[chunk])

    for count in TAGS[:2] if quick else TAGS:
        tags = [begun(made, settings, ANCHORS_M) for _ in range(count)]
        track(tags, 0)
        chunks = iter(range(1, CHUNKS))
        with one_core():
            by_tags[count] = 1e9 * seconds(lambda: partial(track, tags, next(chunks)), 3) / count / CHUNK  # noqa: B023
    shares, chunk, start_s = [tags[k :: cores()] for k in range(cores())], next(chunks), time.perf_counter()
    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(lambda share: track(share, chunk), shares))
    rate = len(tags) * CHUNK / (time.perf_counter() - start_s)
    return {"joint": {"ns_per_message": by_tags, "all_cores_messages_per_s": rate}}


def replay(quick):
    """Rows a second of a made-up recording of each format, decoding and filter together."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in synthetic.MAKERS:
            rows = round((1000 if quick else 10_000) * REPLAYED.get(name, 2.0))
            listener = synthetic.LISTENER.get(name, [None])[-1]
            path = synthetic.write(Path(folder) / name, name, rows)
            asked = ReplayOptions(path, anchors=synthetic.ANCHORS_M, tag_height_m="free", listener=listener)
            found[name] = rows / seconds(lambda: partial(CaptureReplay(asked).run, None, str), 3)  # noqa: B023
    return {"rows_per_s": found}


def monte_carlo(quick, anchors=10):
    """Draws a second of the paper's chain: the best of three rounds, as other work only slows down."""
    draws, chain = 50_000 if quick else 1_000_000, random_chain(anchors)
    ways = {
        "numpy_loop_draws_per_s": (draws // 100, partial(draw_loop, chain)),
        "one_core_draws_per_s": (draws, lambda n: draw_moments(chain, 1, n, threads=1)),
        "all_cores_draws_per_s": (draws, lambda n: draw_moments(chain, 1, n)),
    }
    rates = dict.fromkeys(ways, 0.0)
    for _ in range(3):
        for name, (count, run) in ways.items():
            start_s = time.perf_counter()
            run(count)
            rates[name] = max(rates[name], count / (time.perf_counter() - start_s))
    ratio = rates["one_core_draws_per_s"] / rates["numpy_loop_draws_per_s"]
    return {"anchors": anchors, **rates, "cores": cores(), "ratio": ratio}


def flat(value, name=""):
    """Each figure with the path of its keys."""
    if isinstance(value, dict):
        for key, one in value.items():
            yield from flat(one, f"{name}.{key}" if name else str(key))
    else:
        yield name, value


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a fraction, with fewer and shorter runs")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    load = os.getloadavg()[0]
    with one_core():
        kinds = {"joint": (False, True), "joint_mesh": (True, True), "joint_room": (False, False),
                 "joint_room_mesh": (True, False)}  # fmt: skip
        kernels = {name: kernel(asked.quick, mesh=mesh, exact=exact) for name, (mesh, exact) in kinds.items()}
        result = {"kernels": {**kernels, "streaming": messages(asked.quick)}, "snapshots": snapshots(asked.quick)}
        result["replay"] = replay(asked.quick)
    result |= {"tags": many_tags(asked.quick), "load": load, "cores": cores(), "monte_carlo": monte_carlo(asked.quick)}
    if asked.json:
        print(json.dumps(result))
        return
    print("simulated messages; medians on one core but for all_cores")
    for name, value in flat(result):
        print(f"{name:<44}{value:>16,.3g}" if value < 1e-3 else f"{name:<44}{value:>16,.1f}")


if __name__ == "__main__":
    main()
