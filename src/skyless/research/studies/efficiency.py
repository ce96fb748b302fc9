"""The study ``efficiency``: how near ``joint`` comes to the Cramér–Rao bound in matched episodes in the lab.

Each episode lasts two seconds; errors count after each of its last 20 superframes, as the bound does. The filter
assumes the very noise that the episodes have. Two bounds are given with mesh: of all receptions, and of those that had
come in by then.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from msgspec import Struct
from scipy.stats import chi2

from skyless.core.arrays import Array
from skyless.core.errors import SkylessError
from skyless.core.estimator.estimator import Estimator
from skyless.research.studies.common.plan import Cell, Plan, Row
from skyless.research.studies.episodes import EPISODE_SPEED_STD_MPS, WHITE_FM, Case, Episode, draw_episode, settings_of
from skyless.research.uncertainty.bounds import BoundSettings, tracking_bound
from skyless.sim.lab import paper_lab_site

_JUDGED_SUPERFRAMES: Final = 20
"""At the end of an episode."""

_START_STD_M: Final = 0.3
"""Error of the filter's start, per axis; after two seconds nothing of it is left."""

_CHUNK_EPISODES: Final = 50
"""Episodes in a chunk of a cell."""

_EPISODE_COST_S: Final = 0.02
"""About what an episode and its bounds take."""

_MAX_RATIO: Final = 1.02

_NOISES_PS: Final = (100.0, 150.0)
_WALKS: Final = (1e-9, 1e-8)
_QAS_M2PS3: Final = (0.5, 2.0)
_MESHES: Final = ((False, False), (True, False), (True, True))
"""Without; relayed with an anchor's next frame; known at once."""

EFFICIENCY_CASES: Final = tuple(
    Case(noise_ps, walk, qa, mesh, at_once)
    for mesh, at_once in _MESHES
    for noise_ps in _NOISES_PS
    for walk in _WALKS
    for qa in _QAS_M2PS3
)


class Efficiency(Struct, frozen=True):
    """Results of the episodes of one case; lengths are root mean squares over the last superframes."""

    case: Case
    episodes: int
    rmse_m: float
    ratio_error: float
    """Standard error of ``ratio``; both errors and bound vary with the path."""
    said_m: float
    """Predicted by the filter's covariance."""
    bound_m: float
    """Bound given all receptions that the anchors have made."""
    arrived_bound_m: float
    """Bound given the receptions that the tag knew of, which no receiver can beat."""
    nees: float
    """Mean normalised error squared after the last superframe, 2 for a consistent filter."""
    nees_interval: tuple[float, float]
    """In which ``nees`` lies with a probability of 99 % if the filter is consistent."""

    @property
    def ratio(self) -> float:
        """RMSE over the bound of what the tag knew."""
        return self.rmse_m / self.arrived_bound_m


def summary(case: Case, rows: Array) -> Efficiency:
    """Results of episodes; ``rows`` has one for each of them, as ``run_chunk`` returns it."""
    episodes = len(rows)
    squared, said, bound, arrived, nees = rows.mean(axis=0)
    excess = rows[:, 0] - squared / arrived * rows[:, 3]
    low, high = chi2.ppf([0.005, 0.995], 2 * episodes) / episodes
    return Efficiency(
        case=case,
        episodes=episodes,
        rmse_m=float(np.sqrt(squared)),
        ratio_error=float(excess.std() / np.sqrt(episodes) / np.sqrt(squared * arrived) / 2.0),
        said_m=float(np.sqrt(said)),
        bound_m=float(np.sqrt(bound)),
        arrived_bound_m=float(np.sqrt(arrived)),
        nees=float(nees),
        nees_interval=(float(low), float(high)),
    )


def run_chunk(case: Case, seeds: list[np.random.SeedSequence]) -> Array:
    """One row for each episode: squared error, the filter's variance, both bounds in m², and its last NEES."""
    return np.array([_run(case, np.random.default_rng(seed)) for seed in seeds])


def _run(case: Case, draw: np.random.Generator) -> list[float]:
    site = paper_lab_site()
    anchors = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors])
    episode = draw_episode(draw, anchors, site.schedule.slot_s, case)
    positions_m, covariances_m2 = _filtered(case, anchors, episode, draw)
    ends = np.arange(len(anchors) - 1, len(positions_m), len(anchors))[-_JUDGED_SUPERFRAMES:]
    errors = positions_m[ends] - episode.path_m[ends, :2]
    covariances = covariances_m2[ends]
    bound_m2 = _bound(case, anchors, episode, site.schedule.slot_s, at_once=True)
    arrived_m2 = bound_m2 if case.at_once else _bound(case, anchors, episode, site.schedule.slot_s, at_once=False)
    return [
        float(np.square(errors).sum(axis=1).mean()),
        float(np.trace(covariances, axis1=1, axis2=2).mean()),
        bound_m2,
        arrived_m2,
        float(errors[-1] @ np.linalg.solve(covariances[-1], errors[-1])),
    ]


def _filtered(case: Case, anchors: Array, episode: Episode, draw: np.random.Generator) -> tuple[Array, Array]:
    estimator = Estimator(settings_of(case, height_m=0.0), anchors)
    start = episode.path_m[0, :2] + draw.normal(0.0, _START_STD_M, 2)
    estimator.start(int(episode.packets.rx_ticks[0]), start, _START_STD_M**2 * np.eye(2), EPISODE_SPEED_STD_MPS**2)
    rows = estimator.track(episode.packets)
    return rows["position_m"][:, :2], rows["covariance_m2"][:, :2, :2]


def _bound(case: Case, anchors: Array, episode: Episode, slot_s: float, at_once: bool) -> float:
    settings = BoundSettings(
        case.noise_ps * 1e-12,
        white_fm=WHITE_FM,
        random_walk_fm=case.random_walk_fm,
        qa=case.qa,
        slot_s=slot_s,
        speed_std_mps=EPISODE_SPEED_STD_MPS,
        mesh=case.mesh,
        at_once=at_once,
    )
    bound = tracking_bound(anchors, episode.path_m, settings)[-_JUDGED_SUPERFRAMES:]
    return float(np.trace(bound, axis1=1, axis2=2).mean())


def cells(plan: Plan) -> list[Cell]:
    """Episodes in chunks.

    Raises:
        SkylessError: the method is not one that can be fed with an episode's stamps.
    """
    if plan.method != "joint":
        raise SkylessError(f"--method is {plan.method!r}; the study efficiency is about joint, whose bound it computes")
    return [
        Cell(
            _name(case),
            _run_cell,
            (case, tuple(seeds[first : first + _CHUNK_EPISODES])),
            _EPISODE_COST_S * _CHUNK_EPISODES,
        )
        for case in EFFICIENCY_CASES
        for seeds in [np.random.SeedSequence(plan.seed).spawn(plan.episodes)]
        for first in range(0, plan.episodes, _CHUNK_EPISODES)
    ]


def _run_cell(chunk: tuple[Case, tuple[np.random.SeedSequence, ...]]) -> Array:
    case, seeds = chunk
    return run_chunk(case, list(seeds))


def rows(plan: Plan, results: Sequence[Any]) -> list[Row]:
    """A row for each case; the results stand in the order of ``cells``."""
    each = -(-plan.episodes // _CHUNK_EPISODES)
    return [
        _row(case, np.concatenate(results[each * number : each * (number + 1)]))
        for number, case in enumerate(EFFICIENCY_CASES)
    ]


def _row(case: Case, episodes: Array) -> Row:
    found = summary(case, episodes)
    low, high = found.nees_interval
    return Row(
        study="efficiency",
        method="joint",
        case=_name(case),
        series="at once" if case.at_once else "with mesh" if case.mesh else "without mesh",
        x=None,
        mesh=case.mesh,
        noise_ps=case.noise_ps,
        runs=found.episodes,
        fixes=found.episodes,
        rmse_m=found.rmse_m,
        rmse_error_m=float(episodes[:, 0].std() / np.sqrt(len(episodes)) / (2.0 * found.rmse_m)),
        said_m=found.said_m,
        nees=found.nees / 2.0,
        nees_interval=(low / 2.0, high / 2.0),
        bound_m=found.arrived_bound_m,
        ratio=found.ratio,
        ratio_error=found.ratio_error,
        limit=_MAX_RATIO,
        passed=found.ratio <= _MAX_RATIO,
    )


def _name(case: Case) -> str:
    mesh = "at once" if case.at_once else "mesh" if case.mesh else "no mesh"
    return f"{case.noise_ps:.0f} ps, {case.random_walk_fm:.0e}, qa {case.qa:g}, {mesh}"
