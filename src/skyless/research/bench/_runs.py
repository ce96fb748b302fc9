"""The messages of ``skyless bench``: seven nodes in the lab's room and a tag at rest."""

from collections.abc import Callable, Iterable
from typing import Any, Final

import numpy as np

from skyless.core.arrays import Array, Integers
from skyless.core.estimator.estimator import Estimator, Packets
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.ticks import SPEED_OF_LIGHT_MPS
from skyless.research.bench._baselines import FilterpyJoint, PlainJoint, joint_filter
from skyless.research.studies.episodes import Case, draw_episode, settings_of

Run = Callable[[], object]
"""Prepared before a clock starts, called once while it runs."""

BENCH_NODES: Final = 7
BENCH_SLOT_S: Final = 2.1e-3
_NOISE_M: Final = 100e-12 * SPEED_OF_LIGHT_MPS
_ANGLES: Final = 2.0 * np.pi * np.arange(BENCH_NODES) / BENCH_NODES
BENCH_ANCHORS_M: Final = np.column_stack(
    [3.0 + 4.0 * np.cos(_ANGLES), 4.0 + 5.0 * np.sin(_ANGLES), np.zeros(BENCH_NODES)]
)
_RANGE_ERRORS: Final = ("survey_std_m", "range_std_m", "slope_std_m", "place_std_m")
START_VARIANCES: Final = (0.09, 0.16)
"""Variances of a position and of a speed at the start."""


class JointRuns:
    """The same messages for ``joint``, plain NumPy and filterpy; a loop of 18 states as well."""

    def __init__(self, superframes: int, *, mesh: bool, exact: bool = True) -> None:
        """``exact``: whether the filter assumes exact survey and ranges; else it estimates their errors as well."""
        case = Case(mesh=mesh, qa=0.0)
        episode = draw_episode(np.random.default_rng(1), BENCH_ANCHORS_M, BENCH_SLOT_S, case, superframes)
        self.packets, self.tag_m = episode.packets, episode.path_m[0]
        self.count = len(self.packets.anchors)
        ranges_m, draw = (
            np.linalg.norm(BENCH_ANCHORS_M[self.packets.anchors] - self.tag_m, axis=1),
            np.random.default_rng(2),
        )
        self.pseudoranges_m: Array = ranges_m + draw.normal(0.0, 2.0**0.5 * _NOISE_M, self.count)
        """What a tag with a perfect clock would measure."""
        self._sync_m = draw.normal(0.0, 2.0**0.5 * _NOISE_M, self.count)
        self.settings = settings_of(Case(mesh=mesh), height_m=0.0)
        if not exact:
            usual = EstimatorSettings()
            self.settings = self.settings.changed(**{name: getattr(usual, name) for name in _RANGE_ERRORS})

    def new_estimator(self) -> Estimator:
        """A filter that begins where the tag stands, without any anchor in view."""
        estimator = Estimator(self.settings, BENCH_ANCHORS_M)
        position, speed = START_VARIANCES
        estimator.start(int(self.packets.rx_ticks[0]), self.tag_m[:2], position * np.eye(2), speed)
        return estimator

    def part(self, begin: int, end: int) -> Packets:
        """Some of the packets, with what they relay."""
        p = self.packets
        first = int(p.ends[begin - 1]) if begin else 0
        columns = (p.anchors[begin:end], p.sequences[begin:end], p.rx_ticks[begin:end], p.tx_ticks[begin:end])
        return Packets(*columns, p.relays[first : int(p.ends[end - 1])], p.ends[begin:end] - first)

    def kernel(self) -> Run:
        """All messages through the kernel."""
        estimator = self.new_estimator()
        return lambda: estimator.track(self.packets)

    def plain(self, count: int, kind: type[PlainJoint] = PlainJoint) -> Run:
        """The first messages through plain NumPy or filterpy."""
        p = self.packets
        joint = kind(self.settings, BENCH_ANCHORS_M, int(p.rx_ticks[0]), self.tag_m[:2], START_VARIANCES)
        rows = list(packets_of(p, count))
        return lambda: _each(lambda row: joint.process(*row), rows)

    def filterpy(self, count: int) -> Run:
        """The first messages through filterpy."""
        return self.plain(count, FilterpyJoint)

    def loop(self) -> Run:
        """As many messages through a plain loop of 18 states; all clocks run alike."""
        measured = (self.pseudoranges_m, self._sync_m)
        x, P = np.zeros(18), np.eye(18)
        x[:2] = self.tag_m[:2]
        steps, noise = np.full(self.count, BENCH_SLOT_S), np.array([self.settings.qa, 3.6e-5, 0.09])
        return lambda: joint_filter(x, P, BENCH_ANCHORS_M, self.packets.anchors, steps, *measured, 2e-3, noise)


def packets_of(packets: Packets, count: int) -> Iterable[tuple[int, int, int, int, Integers]]:
    """The first packets as arguments of ``Estimator.process``."""
    begin = 0
    for k, end in enumerate(packets.ends[:count].tolist()):
        yield (
            int(packets.anchors[k]),
            int(packets.sequences[k]),
            int(packets.rx_ticks[k]),
            int(packets.tx_ticks[k]),
            packets.relays[begin:end],
        )
        begin = end


def _each(process: Callable[[Any], object], rows: Iterable[Any]) -> None:
    for row in rows:
        process(row)
