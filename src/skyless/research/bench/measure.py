"""How fast the receiver's kernels are here, compared with plain implementations (``docs/speed.md``)."""

import os
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from typing import Final

import numpy as np
from msgspec import Struct
from scipy.optimize import least_squares

from skyless.core.air.frame import Reception
from skyless.core.arrays import Array
from skyless.core.estimator.estimator import Estimator
from skyless.core.extras import how_to_install
from skyless.core.processors import cores
from skyless.core.protocol1.beacon import decode_cached
from skyless.core.tag.position import PseudorangeSolution, locate_pseudoranges
from skyless.core.tag.receiver import Receiver
from skyless.research.bench._runs import BENCH_ANCHORS_M, BENCH_NODES, JointRuns, Run
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import lab_site
from skyless.sim.trajectory import Static

_NO_FILTERPY: Final = f"filterpy is not installed; {how_to_install('bench')}"
_WARM_S: Final = 2.0
"""A receiver has its almanac and its first fix by then."""
_TAGS: Final = (1, 100, 10_000)
_CHUNK_SUPERFRAMES: Final = 10
"""Superframes of each tag in one call."""
_CHUNKS: Final = 64


class Effort(Struct, frozen=True):
    """How much is measured."""

    runs: int = 9
    superframes: int = 1000
    plain_messages: int = 280
    streaming_s: float = 8.0


FULL_EFFORT: Final = Effort()
QUICK_EFFORT: Final = Effort(3, 120, 42, 3.0)


class KernelSpeed(Struct, frozen=True):
    """Messages per second on one core; every ``ratio`` is the kernel's rate over another's."""

    messages_per_s: float
    ratio: float
    """To plain NumPy."""
    numpy_messages_per_s: float
    loop_messages_per_s: float
    """Messages per second of a plain Numba loop of 18 states with a sync update."""
    loop_ratio: float
    filterpy_messages_per_s: float | None = None
    """Measured for ``joint`` only."""
    filterpy_ratio: float | None = None


class StreamingSpeed(Struct, frozen=True):
    """Seconds of a core per beacon, from bytes to fix: ``Receiver.hear``, every frame for the first time."""

    seconds_per_message: float


class Kernels(Struct, frozen=True):
    """The filters."""

    joint: KernelSpeed
    """As ``joint_mesh`` at a site whose survey and ranges are exact, as plain NumPy and the loop assume; ..."""
    joint_mesh: KernelSpeed
    joint_room: KernelSpeed
    """... this and the next estimate their errors as well: 54 states."""
    joint_room_mesh: KernelSpeed
    streaming: StreamingSpeed


class SnapshotSpeed(Struct, frozen=True):
    """Positions per second from seven pseudoranges, without a guess; of scipy's ``least_squares`` with one."""

    fixes_per_s: float
    scipy_fixes_per_s: float
    ratio: float


class TagsSpeed(Struct, frozen=True):
    """Many tags in one process, ``_CHUNK_SUPERFRAMES`` superframes of each in a call."""

    ns_per_message: dict[int, float]
    """By the number of tags, on one core."""
    all_cores_messages_per_s: float
    """With the most tags."""


class Speed(Struct, frozen=True):
    """All of it."""

    kernels: Kernels
    snapshots: SnapshotSpeed
    tags: dict[str, TagsSpeed]
    """By method."""
    load: float | None
    """Programs that wanted a core in the last minute."""
    cores: int
    filterpy_missing: str | None
    """Why filterpy was not measured, None if it was."""


def measure_all(effort: Effort = FULL_EFFORT) -> Speed:
    """Measure everything: medians of several short runs, by the time of a thread that stays on one core."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    with one_core():
        kernels = Kernels(
            _joint(effort, mesh=False, filterpy=find_spec("filterpy") is not None),
            _joint(effort, mesh=True),
            _joint(effort, mesh=False, exact=False),
            _joint(effort, mesh=True, exact=False),
            _streaming(effort),
        )
        snapshots = _snapshots(effort)
    tags = {"joint": _many_joints()}
    return Speed(kernels, snapshots, tags, load, cores(), None if find_spec("filterpy") else _NO_FILTERPY)


def seconds(prepare: Callable[[], Run], runs: int) -> float:
    """Median of the thread's own time over several runs, after one that is not counted and may compile."""
    prepare()()
    times = []
    for _ in range(runs):
        run = prepare()
        started_s = time.thread_time()
        run()
        times.append(time.thread_time() - started_s)
    return statistics.median(times)


def _joint(effort: Effort, *, mesh: bool, exact: bool = True, filterpy: bool = False) -> KernelSpeed:
    runs, few = JointRuns(effort.superframes, mesh=mesh, exact=exact), effort.plain_messages
    own = runs.count / seconds(runs.kernel, effort.runs)
    loop = runs.count / seconds(runs.loop, effort.runs)
    plain = few / seconds(lambda: runs.plain(few), 3)
    other = few / seconds(lambda: runs.filterpy(few), 3) if filterpy else None
    return KernelSpeed(own, own / plain, plain, loop, own / loop, other, own / other if other else None)


def _streaming(effort: Effort) -> StreamingSpeed:
    world = world_of(lab_site(), [Static(3.0, 4.0)], lab_impairments(100.0), 1)
    heard = [reception for sent in world.run(_WARM_S + effort.streaming_s) for _, reception, _ in sent.receptions()]
    warm = round(len(heard) * _WARM_S / (_WARM_S + effort.streaming_s))
    return StreamingSpeed(
        seconds(partial(_prepared_receiver, heard, warm), max(3, effort.runs // 2)) / (len(heard) - warm)
    )


def _prepared_receiver(heard: list[Reception], warm: int) -> Run:
    receiver = Receiver()
    for reception in heard[:warm]:
        receiver.hear(reception)
    decode_cached.cache_clear()
    rest = heard[warm:]

    def run() -> None:
        fixes = sum(receiver.hear(reception) is not None for reception in rest)
        assert fixes > 0.9 * len(rest), "a receiver that is measured has to make fixes"

    return run


def _snapshots(effort: Effort) -> SnapshotSpeed:
    runs = JointRuns(effort.plain_messages // BENCH_NODES + 1, mesh=False)
    rows = runs.pseudoranges_m[: effort.plain_messages // BENCH_NODES * BENCH_NODES].reshape(-1, BENCH_NODES)
    variances, middle = np.full(BENCH_NODES, 2e-3), np.array([*BENCH_ANCHORS_M[:, :2].mean(axis=0), 0.0])

    def residuals(unknown: Array, pseudoranges_m: Array) -> Array:
        away = BENCH_ANCHORS_M[:, :2] - unknown[:2]
        left: Array = np.hypot(away[:, 0], away[:, 1]) + unknown[2] - pseudoranges_m
        return left

    def own() -> None:
        for row in rows:
            solution = locate_pseudoranges(BENCH_ANCHORS_M, row, variances, height_m=0.0)
            assert isinstance(solution, PseudorangeSolution)

    def other() -> None:
        for row in rows:
            least_squares(residuals, middle, method="lm", args=(row,))

    ours, scipys = len(rows) / seconds(lambda: own, 3), len(rows) / seconds(lambda: other, 3)
    return SnapshotSpeed(ours, scipys, ours / scipys)


@contextmanager
def one_core() -> Iterator[None]:
    """Keep this thread on one core, where the system can."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _many_joints() -> TagsSpeed:
    """Measure ``joint``."""
    runs, size = JointRuns(_CHUNK_SUPERFRAMES * _CHUNKS, mesh=False), _CHUNK_SUPERFRAMES * BENCH_NODES
    parts = [runs.part(k * size, (k + 1) * size) for k in range(_CHUNKS)]

    def process(tags: Iterable[Estimator], chunk: int) -> None:
        for tag in tags:
            tag.track(parts[chunk])

    by_tags: dict[int, float] = {}
    for count in _TAGS:
        tags = [runs.new_estimator() for _ in range(count)]
        process(tags, 0)
        rounds = range(1, min(_CHUNKS - 1, max(4, 2000 // count)))
        with one_core():
            times = []
            for chunk in rounds:
                started_s = time.thread_time()
                process(tags, chunk)
                times.append(time.thread_time() - started_s)
        by_tags[count] = 1e9 * statistics.median(times) / (count * size)
    shares = [tags[k :: cores()] for k in range(cores())]
    started_s = time.perf_counter()
    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(lambda share: process(share, len(rounds) + 1), shares))
    return TagsSpeed(by_tags, len(tags) * size / (time.perf_counter() - started_s))
