"""Many tags in one process, as ``skyless bench`` measures them: what one more tag costs, and all cores at once."""

import os
import statistics
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Final

from msgspec import Struct

from skyless.bench.runs import NODES, JointRuns
from skyless.kernels.compiled import cores

TAGS: Final = (1, 100, 10_000)
CHUNK: Final = 10
"""Superframes that each tag takes in a call."""
CHUNKS: Final = 64

Tag = Callable[[int], None]
"""Takes the chunk of that number."""


class TagsSpeed(Struct, frozen=True):
    """Many tags in one process, ``CHUNK`` superframes of each in a call."""

    ns_per_message: dict[int, float]
    """By the number of tags, on one core."""
    all_cores_messages_per_s: float
    """With the most tags."""


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


def many_joints() -> TagsSpeed:
    """Measure ``joint``."""
    runs = JointRuns(CHUNK * CHUNKS, mesh=False)
    parts = [runs.part(k * CHUNK * NODES, (k + 1) * CHUNK * NODES) for k in range(CHUNKS)]

    def tag() -> Tag:
        estimator = runs.begun()
        return lambda chunk: estimator.track(parts[chunk])

    return _many(tag)


def _many(new_tag: Callable[[], Tag]) -> TagsSpeed:
    by_tags, size = {}, CHUNK * NODES
    for count in TAGS:
        tags = [new_tag() for _ in range(count)]
        _take(tags, 0)
        rounds = range(1, min(CHUNKS - 1, max(4, 2000 // count)))
        with one_core():
            times = []
            for chunk in rounds:
                started_s = time.thread_time()
                _take(tags, chunk)
                times.append(time.thread_time() - started_s)
        by_tags[count] = 1e9 * statistics.median(times) / (count * size)
    shares = [tags[k :: cores()] for k in range(cores())]
    started_s = time.perf_counter()
    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(lambda share: _take(share, len(rounds) + 1), shares))
    return TagsSpeed(by_tags, len(tags) * size / (time.perf_counter() - started_s))


def _take(tags: list[Tag], chunk: int) -> None:
    for tag in tags:
        tag(chunk)
