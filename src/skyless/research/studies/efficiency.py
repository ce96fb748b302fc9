"""The study ``efficiency``: how near ``joint`` comes to the Cramér–Rao bound in matched episodes in the lab.

Each episode lasts two seconds; errors count after each of its last 20 superframes, as the bound does. The filter
assumes the very noise that the episodes have. The bound is that of the receptions that the tag knew of by then.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from scipy.stats import chi2

from skyless.core.arrays import Array
from skyless.core.errors import SkylessError
from skyless.core.estimator.estimator import Estimator
from skyless.research.studies.common.plan import Cell, Plan, Row
from skyless.research.studies.episodes import EPISODE_SPEED_STD_MPS, WHITE_FM, Case, Episode, draw_episode, settings_of
from skyless.research.uncertainty.bounds import BoundSettings, tracking_bound
from skyless.sim.world import paper_lab_site

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


def run_chunk(case: Case, seeds: list[np.random.SeedSequence]) -> Array:
    """One row for each episode: squared error, the filter's variance and the bound in m², and its last NEES."""
    return np.array([_run(case, np.random.default_rng(seed)) for seed in seeds])


def _run(case: Case, draw: np.random.Generator) -> list[float]:
    site = paper_lab_site()
    anchors = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors])
    episode = draw_episode(draw, anchors, site.schedule.slot_s, case)
    positions_m, covariances_m2 = _filtered(case, anchors, episode, draw)
    ends = np.arange(len(anchors) - 1, len(positions_m), len(anchors))[-_JUDGED_SUPERFRAMES:]
    errors = positions_m[ends] - episode.path_m[ends, :2]
    covariances = covariances_m2[ends]
    return [
        float(np.square(errors).sum(axis=1).mean()),
        float(np.trace(covariances, axis1=1, axis2=2).mean()),
        _bound(case, anchors, episode, site.schedule.slot_s),
        float(errors[-1] @ np.linalg.solve(covariances[-1], errors[-1])),
    ]


def _filtered(case: Case, anchors: Array, episode: Episode, draw: np.random.Generator) -> tuple[Array, Array]:
    estimator = Estimator(settings_of(case, height_m=0.0), anchors)
    start = episode.path_m[0, :2] + draw.normal(0.0, _START_STD_M, 2)
    estimator.start(int(episode.packets.rx_ticks[0]), start, _START_STD_M**2 * np.eye(2), EPISODE_SPEED_STD_MPS**2)
    rows = estimator.track(episode.packets)
    return rows["position_m"][:, :2], rows["covariance_m2"][:, :2, :2]


def _bound(case: Case, anchors: Array, episode: Episode, slot_s: float) -> float:
    settings = BoundSettings(
        case.noise_ps * 1e-12,
        white_fm=WHITE_FM,
        random_walk_fm=case.random_walk_fm,
        qa=case.qa,
        slot_s=slot_s,
        speed_std_mps=EPISODE_SPEED_STD_MPS,
        mesh=case.mesh,
        at_once=case.at_once,
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
            partial(run_chunk, case, seeds[first : first + _CHUNK_EPISODES]),
            _EPISODE_COST_S * _CHUNK_EPISODES,
        )
        for case in EFFICIENCY_CASES
        for seeds in [np.random.SeedSequence(plan.seed).spawn(plan.episodes)]
        for first in range(0, plan.episodes, _CHUNK_EPISODES)
    ]


def rows(plan: Plan, results: Sequence[Any]) -> list[Row]:
    """A row for each case; the results stand in the order of ``cells``."""
    each = -(-plan.episodes // _CHUNK_EPISODES)
    return [
        row_of(case, np.concatenate(results[each * number : each * (number + 1)]))
        for number, case in enumerate(EFFICIENCY_CASES)
    ]


def row_of(case: Case, rows: Array) -> Row:
    """The row of a case; ``rows`` has one for each of its episodes, as ``run_chunk`` returns it."""
    episodes = len(rows)
    squared, said, bound, nees = rows.mean(axis=0).tolist()
    rmse_m, bound_m = squared**0.5, bound**0.5
    low, high = chi2.ppf([0.005, 0.995], 2 * episodes) / (2 * episodes)
    excess = rows[:, 0] - squared / bound * rows[:, 2]  # both errors and bound vary with the path
    return Row(
        study="efficiency",
        method="joint",
        case=_name(case),
        series="at once" if case.at_once else "with mesh" if case.mesh else "without mesh",
        mesh=case.mesh,
        noise_ps=case.noise_ps,
        runs=episodes,
        fixes=episodes,
        rmse_m=rmse_m,
        rmse_error_m=float(rows[:, 0].std() / np.sqrt(episodes) / (2.0 * rmse_m)),
        said_m=said**0.5,
        nees=nees / 2.0,
        nees_interval=(float(low), float(high)),
        bound_m=bound_m,
        ratio=rmse_m / bound_m,
        ratio_error=float(excess.std() / np.sqrt(episodes) / (2.0 * rmse_m * bound_m)),
        limit=_MAX_RATIO,
        passed=rmse_m / bound_m <= _MAX_RATIO,
    )


def _name(case: Case) -> str:
    mesh = "at once" if case.at_once else "mesh" if case.mesh else "no mesh"
    return f"{case.noise_ps:.0f} ps, {case.random_walk_fm:.0e}, qa {case.qa:g}, {mesh}"
