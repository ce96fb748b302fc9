"""How near ``joint`` comes to the Cramér–Rao bound: matched constant-velocity episodes in the lab.

Each episode lasts two seconds; errors count after each of its last 20 superframes, as the bound does. The filter
assumes the very noise that the episodes have. Two bounds are given with mesh: of all receptions, and of those that had
come in by then.
"""

from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Final

import numpy as np
from msgspec import Struct
from scipy.stats import chi2

from skyless.evaluation.lab_bound import LAST, SPEED_STD_MPS, WHITE_FM
from skyless.kernels.arrays import Array
from skyless.kernels.compiled import cores
from skyless.positioning.estimator.estimator import Estimator
from skyless.site.lab import ideal_lab_site
from skyless.studies.episodes import Case, Episode, draw_episode, settings_of
from skyless.uncertainty.bounds import bound_settings, tracking_bound

START_STD_M: Final = 0.3
"""The filter starts so far off, per axis; after two seconds nothing of it is left."""

CHUNK: Final = 50
"""Episodes that a thread takes at a time."""

NOISE_AND_AGILITY: Final = ((100.0, 1e-9, 0.5), (150.0, 1e-9, 0.5), (100.0, 1e-9, 2.0), (100.0, 1e-8, 0.5))
CASES: Final = tuple(
    Case(noise_ps, walk, qa, mesh, at_once)
    for noise_ps, walk, qa in NOISE_AND_AGILITY
    for mesh, at_once in ((False, False), (True, False), (True, True))
)
"""Stamp noise, random walk and agility, each without mesh, with it, and with receptions that are known at once."""


class Efficiency(Struct, frozen=True):
    """What the episodes of one case came to; lengths are root mean squares over the last superframes."""

    case: Case
    episodes: int
    rmse_m: float
    ratio_error: float
    """Standard error of ``ratio``; both errors and bound vary with the path."""
    said_m: float
    """What the filter's covariance says."""
    bound_m: float
    """Of all receptions that the anchors have made."""
    arrived_bound_m: float
    """Of those that the tag knew of; the bound of any receiver."""
    nees: float
    """Mean normalised error squared after the last superframe, 2 for a consistent filter."""
    nees_interval: tuple[float, float]
    """In which ``nees`` lies with a probability of 99 % if the filter is consistent."""

    @property
    def ratio(self) -> float:
        """RMSE over the bound of what the tag knew."""
        return self.rmse_m / self.arrived_bound_m


def efficiency(case: Case, episodes: int, seed: int, pool: Executor | None = None) -> Efficiency:
    """Run the episodes of a case; they depend on the seed and their number alone."""
    seeds = np.random.SeedSequence(seed).spawn(episodes)
    chunks = [(case, seeds[first : first + CHUNK]) for first in range(0, episodes, CHUNK)]
    if pool is None:
        with ThreadPoolExecutor(cores()) as own:
            parts = list(own.map(run_chunk, *zip(*chunks, strict=True)))
    else:
        parts = list(pool.map(run_chunk, *zip(*chunks, strict=True)))
    return summary(case, np.concatenate(parts))


def summary(case: Case, rows: Array) -> Efficiency:
    """What episodes come to; a row for each of them, as ``run_chunk`` gives it."""
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
    site = ideal_lab_site()
    anchors = np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors])
    episode = draw_episode(draw, anchors, site.schedule.slot_s, case)
    motions, variances = _filtered(case, anchors, episode, draw)
    ends = np.arange(len(anchors) - 1, len(motions), len(anchors))[-LAST:]
    errors = motions[ends, :2] - episode.path_m[ends, :2]
    covariances = variances[ends].reshape(-1, 2, 2)
    bounds = [_bound(case, anchors, episode, site.schedule.slot_s, at_once) for at_once in (True, False)]
    return [
        float(np.square(errors).sum(axis=1).mean()),
        float(np.trace(covariances, axis1=1, axis2=2).mean()),
        bounds[0],
        bounds[0] if case.at_once else bounds[1],
        float(errors[-1] @ np.linalg.solve(covariances[-1], errors[-1])),
    ]


def _filtered(case: Case, anchors: Array, episode: Episode, draw: np.random.Generator) -> tuple[Array, Array]:
    estimator = Estimator(settings_of(case, height_m=0.0), anchors)
    start = episode.path_m[0, :2] + draw.normal(0.0, START_STD_M, 2)
    estimator.start(int(episode.packets.rx_ticks[0]), start, START_STD_M**2 * np.eye(2), SPEED_STD_MPS**2)
    frames = len(episode.path_m)
    motions, variances = np.empty((frames, 4)), np.empty((frames, 4))
    estimator.track(episode.packets, motions, variances)
    return motions, variances


def _bound(case: Case, anchors: Array, episode: Episode, slot_s: float, at_once: bool) -> float:
    settings = bound_settings(
        case.noise_ps * 1e-12,
        white_fm=WHITE_FM,
        random_walk_fm=case.random_walk_fm,
        qa=case.qa,
        slot_s=slot_s,
        speed_std_mps=SPEED_STD_MPS,
        mesh=case.mesh,
        at_once=at_once,
    )
    bound = tracking_bound(anchors, episode.path_m, settings)[-LAST:]
    return float(np.trace(bound, axis1=1, axis2=2).mean())
