"""How fast the receiver's kernels are here, beside what others would write (``docs/speed.md``)."""

import os
import statistics
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import Final

import numpy as np
from msgspec import Struct
from scipy.optimize import least_squares

from skyless.air.codec import decode_cached
from skyless.air.reception import Reception
from skyless.anchor import Anchor
from skyless.bench.many_tags import TagsSpeed, many_joints, one_core
from skyless.bench.runs import ANCHORS_M, NODES, JointRuns, Run
from skyless.kernels.arrays import Array
from skyless.kernels.compiled import cores
from skyless.positioning.solver.locate import PseudorangeSolution, locate_pseudoranges
from skyless.receiver import Receiver
from skyless.simulation.impairments import lab_impairments
from skyless.simulation.stations import TagSpec
from skyless.simulation.trajectory import Static
from skyless.simulation.world import World
from skyless.site.lab import ideal_lab_site

NO_FILTERPY: Final = "filterpy is not installed; pip install 'skyless[bench]' adds it"
WARM_S: Final = 2.0
"""A receiver has its almanac and its first fix by then."""


class Effort(Struct, frozen=True):
    """How much is measured."""

    runs: int = 9
    superframes: int = 1000
    plain_messages: int = 280
    streaming_s: float = 8.0


FULL: Final = Effort()
QUICK: Final = Effort(3, 120, 42, 3.0)


class KernelSpeed(Struct, frozen=True):
    """Messages per second on one core; every ``ratio`` is the kernel's rate over another's."""

    messages_per_s: float
    ratio: float
    """To plain NumPy."""
    numpy_messages_per_s: float
    loop_messages_per_s: float
    """Of a plain Numba loop of 18 states with a sync update."""
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
    """As ``joint_mesh`` at a site that calls survey and ranges exact, as plain NumPy and the loop take them for; ..."""
    joint_mesh: KernelSpeed
    joint_room: KernelSpeed
    """... this and the next estimate their errors as well: 54 states."""
    joint_room_mesh: KernelSpeed
    streaming: StreamingSpeed


class SnapshotSpeed(Struct, frozen=True):
    """Positions per second from seven pseudoranges each, without a guess, beside scipy's ``least_squares`` with one."""

    fixes_per_s: float
    scipy_fixes_per_s: float
    ratio: float


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


def measure_all(effort: Effort = FULL) -> Speed:
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
    tags = {"joint": many_joints()}
    return Speed(kernels, snapshots, tags, load, cores(), None if find_spec("filterpy") else NO_FILTERPY)


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
    site = ideal_lab_site()
    world = World(site, lambda anchor: Anchor(site, anchor), [TagSpec(Static(3.0, 4.0))], lab_impairments(100.0), 1)
    heard = [reception for sent in world.run(WARM_S + effort.streaming_s) for _, reception, _ in sent.receptions()]
    warm = round(len(heard) * WARM_S / (WARM_S + effort.streaming_s))
    return StreamingSpeed(seconds(partial(_hearing, heard, warm), max(3, effort.runs // 2)) / (len(heard) - warm))


def _hearing(heard: list[Reception], warm: int) -> Run:
    receiver = Receiver()
    for reception in heard[:warm]:
        receiver.hear(reception)
    decode_cached.cache_clear()
    rest = heard[warm:]

    def run() -> None:
        for reception in rest:
            receiver.hear(reception)

    return run


def _snapshots(effort: Effort) -> SnapshotSpeed:
    runs = JointRuns(effort.plain_messages // NODES + 1, mesh=False)
    rows = runs.pseudoranges_m[: effort.plain_messages // NODES * NODES].reshape(-1, NODES)
    variances, middle = np.full(NODES, 2e-3), np.array([*ANCHORS_M[:, :2].mean(axis=0), 0.0])

    def residuals(unknown: Array, pseudoranges_m: Array) -> Array:
        away = ANCHORS_M[:, :2] - unknown[:2]
        left: Array = np.hypot(away[:, 0], away[:, 1]) + unknown[2] - pseudoranges_m
        return left

    def own() -> None:
        for row in rows:
            solution = locate_pseudoranges(ANCHORS_M, row, variances, height_m=0.0)
            assert isinstance(solution, PseudorangeSolution)

    def other() -> None:
        for row in rows:
            least_squares(residuals, middle, method="lm", args=(row,))

    ours, scipys = (len(rows) / seconds(partial(_as_it_is, run), 3) for run in (own, other))
    return SnapshotSpeed(ours, scipys, ours / scipys)


def _as_it_is(run: Run) -> Run:
    """A run that needs no preparation."""
    return run
