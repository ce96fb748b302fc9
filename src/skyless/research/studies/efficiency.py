"""The study ``efficiency``: RMSE of ``joint`` over the Cramér–Rao bound in matched episodes in the lab.

Each episode lasts two seconds; errors count after each of its last 20 superframes, as the bound does. The filter
assumes the very noise that the episodes have. The bound is that of the receptions that the tag knew of by then.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from msgspec import Struct
from numpy.random import Generator, SeedSequence, default_rng
from scipy.stats import chi2

from skyless.core.arrays import Array, Integers
from skyless.core.errors import SkylessError
from skyless.core.estimator.estimator import Estimator, Packets
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.geometry import anchor_positions
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M
from skyless.research.studies.runner import Cell, Limit, Plan, Row, of_cases, with_limits
from skyless.research.uncertainty import BoundSettings, tracking_bound
from skyless.sim.lab import paper_lab_site

# Episodes of one tag in the lab, simulated to the stamps alone: quick to draw, with just the noise of the bounds.
#
# Every oscillator has white and random-walk frequency noise, every TX stamp an error that all receivers of the frame
# share, every RX stamp its own. Stamps are whole ticks.

EPISODE_SUPERFRAMES: Final = 134
"""Two seconds, after which the state before the first frame no longer matters."""
EPISODE_SPEED_STD_MPS: Final = 0.4
"""Standard deviation of each component of a tag's velocity at the start."""
WHITE_FM: Final = 2e-11

_CRYSTALS_PPM: Final = 10.0
_OFFSETS_M: Final = 1e6
"""Range of the counters at the start."""


class Case(Struct, frozen=True):
    """What all episodes of a study's case have in common."""

    noise_ps: float = 100.0
    """Noise of a stamp, TX and RX alike."""
    random_walk_fm: float = 1e-9
    qa: float = 0.5
    mesh: bool = False
    """Whether anchors relay their receptions of all anchors, not only of the master."""
    at_once: bool = False
    """Whether an anchor's reception is known at once, not with its next frame."""


class Episode(Struct, frozen=True):
    """Receptions of one tag, and its path."""

    packets: Packets
    path_m: Array
    """Position at each frame, shape (frames, 3)."""


def draw_episode(
    draw: Generator, anchors_m: Array, slot_s: float, case: Case, superframes: int = EPISODE_SUPERFRAMES
) -> Episode:
    """Draw one episode: the tag starts in the middle half of the room, one frame of each anchor in a superframe."""
    n = len(anchors_m)
    frames = superframes * n
    low, high = anchors_m[:, :2].min(axis=0), anchors_m[:, :2].max(axis=0)
    path_m = random_path(draw, (low + high) / 2.0, (high - low) / 4.0, slot_s, frames, case.qa)
    senders = np.arange(frames) % n
    time_m = np.arange(frames) * (slot_s * SPEED_OF_LIGHT_MPS)
    offsets, rates = _clocks(draw, frames, n + 1, slot_s, case.random_walk_fm)
    noise_m = case.noise_ps * 1e-12 * SPEED_OF_LIGHT_MPS
    ideal_tx = time_m + offsets[np.arange(frames), senders]
    tx_ticks = _ticks(ideal_tx)
    left = tx_ticks * TICK_M - ideal_tx + noise_m * draw.normal(size=frames)
    between = np.linalg.norm(anchors_m[:, None] - anchors_m[None], axis=2)
    way = np.column_stack([between[senders], np.linalg.norm(path_m - anchors_m[senders], axis=1)])
    arrived = (left[:, None] + way) * (1.0 + rates / SPEED_OF_LIGHT_MPS)
    rx_ticks = _ticks(time_m[:, None] + offsets + arrived + noise_m * draw.normal(size=(frames, n + 1)))
    relays, ends = _relays(rx_ticks, senders, n, case)
    packets = Packets(senders, np.arange(frames) // n % 256, rx_ticks[:, n].copy(), tx_ticks, relays, ends)
    return Episode(packets, path_m)


def random_path(draw: Generator, middle: Array, half: Array, step_s: float, steps: int, qa: float) -> Array:
    """Positions every ``step_s`` of a tag with random acceleration, shape (steps, 3), at height 0."""
    start, velocity = draw.uniform(middle - half, middle + half), draw.normal(0.0, EPISODE_SPEED_STD_MPS, 2)
    kicks = draw.normal(size=(2, steps - 1, 2)) * np.sqrt(qa * step_s)
    velocities = velocity + np.vstack([np.zeros(2), np.cumsum(kicks[0], axis=0)])
    moves = step_s * (velocities[:-1] + kicks[0] / 2.0 + kicks[1] / np.sqrt(12.0))
    path = np.zeros((steps, 3))
    path[:, :2] = start + np.vstack([np.zeros(2), np.cumsum(moves, axis=0)])
    return path


def settings_of(case: Case, height_m: float | None) -> EstimatorSettings:
    """The settings of a filter whose model is exactly that of an episode."""
    light2 = SPEED_OF_LIGHT_MPS**2
    stamp = light2 * (case.noise_ps * 1e-12) ** 2
    return EstimatorSettings(
        qa=case.qa,
        white=light2 * WHITE_FM**2,
        walk=light2 * case.random_walk_fm**2,
        tx_variance_m2=stamp,
        rx_variance_m2=stamp + TICK_M**2 / 12.0,
        height_m=height_m,
        survey_std_m=0.0,
        range_std_m=0.0,
        slope_std_m=0.0,
        place_std_m=0.0,
    )


def _ticks(metres: Array) -> Integers:
    return np.rint(metres / TICK_M).astype(np.int64)


def _clocks(draw: Generator, frames: int, clocks: int, step_s: float, random_walk_fm: float) -> tuple[Array, Array]:
    """Offsets in metres and rates in m/s at every frame, shape (frames, clocks)."""
    light = SPEED_OF_LIGHT_MPS
    kicks = draw.normal(size=(2, frames - 1, clocks))
    walks = kicks[0] * (random_walk_fm * light * np.sqrt(step_s))
    own = kicks[1] * (light * np.sqrt(step_s * (WHITE_FM**2 + random_walk_fm**2 * step_s**2 / 12.0)))
    rates = np.empty((frames, clocks))
    rates[0] = draw.uniform(-_CRYSTALS_PPM, _CRYSTALS_PPM, clocks) * (1e-6 * light)
    rates[1:] = rates[0] + np.cumsum(walks, axis=0)
    offsets = np.empty((frames, clocks))
    offsets[0] = draw.uniform(0.0, _OFFSETS_M, clocks)
    offsets[1:] = offsets[0] + np.cumsum(rates[:-1] * step_s + walks * (step_s / 2.0) + own, axis=0)
    return offsets, rates


def _relays(rx_ticks: Integers, senders: Integers, n: int, case: Case) -> tuple[Integers, Integers]:
    """Rows of (listener, sender, sequence, RX ticks) in the order in which the tag gets them, and where frames end."""
    frames = np.arange(len(senders))
    rows = []
    for back in range(1, n):
        heard = frames if case.at_once else frames - back
        listener = (senders + back) % n if case.at_once else senders
        known = (heard >= 0) & (case.mesh | (senders[heard] == 0))
        at, of, by = frames[known], heard[known], listener[known]
        rows.append(np.column_stack([at, by, senders[of], of // n % 256, rx_ticks[of, by]]))
    table = np.concatenate(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return np.ascontiguousarray(table[:, 1:]), np.searchsorted(table[:, 0], frames, side="right")


_JUDGED_SUPERFRAMES: Final = 20
"""At the end of an episode."""

START_STD_M: Final = 0.3
"""Error of the filter's start, per axis; it no longer matters after two seconds."""

_CHUNK_EPISODES: Final = 50
"""Episodes in a chunk of a cell."""

_EPISODE_COST_S: Final = 0.02
"""Approximate CPU time of an episode and its bounds."""

_MAX_RATIO: Final = 1.02

_MESHES: Final = ((False, False), (True, False), (True, True))
"""Without; relayed with an anchor's next frame; known at once."""

EFFICIENCY_CASES: Final = tuple(
    Case(noise_ps, walk, qa, mesh, at_once)
    for mesh, at_once in _MESHES
    for noise_ps in (100.0, 150.0)
    for walk in (1e-9, 1e-8)
    for qa in (0.5, 2.0)
)


def run_chunk(case: Case, seeds: list[SeedSequence]) -> Array:
    """One row for each episode: squared error, the filter's variance and the bound in m², and its last NEES."""
    return np.array([_run(case, default_rng(seed)) for seed in seeds])


def _run(case: Case, draw: Generator) -> list[float]:
    site = paper_lab_site()
    anchors = anchor_positions(site)
    episode = draw_episode(draw, anchors, site.schedule.slot_s, case)
    start_m = episode.path_m[0, :2] + draw.normal(0.0, START_STD_M, 2)
    rows = tracked(settings_of(case, height_m=0.0), anchors, episode.packets, start_m)
    ends = np.arange(len(anchors) - 1, len(rows), len(anchors))[-_JUDGED_SUPERFRAMES:]
    errors = rows["position_m"][ends, :2] - episode.path_m[ends, :2]
    covariances = rows["covariance_m2"][ends, :2, :2]
    schedule = BoundSettings(
        case.noise_ps * 1e-12,
        white_fm=WHITE_FM,
        random_walk_fm=case.random_walk_fm,
        qa=case.qa,
        slot_s=site.schedule.slot_s,
        speed_std_mps=EPISODE_SPEED_STD_MPS,
        mesh=case.mesh,
        at_once=case.at_once,
    )
    bound = tracking_bound(anchors, episode.path_m, schedule)[-_JUDGED_SUPERFRAMES:]
    return [
        float(np.square(errors).sum(axis=1).mean()),
        float(np.trace(covariances, axis1=1, axis2=2).mean()),
        float(np.trace(bound, axis1=1, axis2=2).mean()),
        float(errors[-1] @ np.linalg.solve(covariances[-1], errors[-1])),
    ]


def tracked(
    settings: EstimatorSettings, anchors_m: Array, packets: Packets, start_m: Array, *, has_levels: bool = False
) -> Any:  # noqa: ANN401 - rows of the estimator
    """The filter's rows after every packet, from a start with a standard deviation of ``START_STD_M`` per axis."""
    estimator = Estimator(settings, anchors_m)
    dim = estimator.dim
    estimator.start(int(packets.rx_ticks[0]), start_m[:dim], START_STD_M**2 * np.eye(dim), EPISODE_SPEED_STD_MPS**2)
    return estimator.track(packets, has_levels=has_levels)


def cells(plan: Plan) -> list[Cell]:
    """Episodes in chunks. Raises SkylessError if the method is not one that can be fed with an episode's stamps."""
    if plan.method != "joint":
        raise SkylessError(f"--method is {plan.method!r}; the study efficiency is about joint, whose bound it computes")
    return [
        cell
        for case in EFFICIENCY_CASES
        for cell in episode_cells(_name(case), partial(run_chunk, case), SeedSequence(plan.seed), plan, _EPISODE_COST_S)
    ]


def episode_cells(
    name: str, run: Callable[[list[SeedSequence]], Any], seed: SeedSequence, plan: Plan, cost_s: float
) -> list[Cell]:
    """The episodes of a case in chunks; ``run`` gets a chunk's seeds, ``cost_s`` is the CPU time of an episode."""
    seeds = seed.spawn(plan.episodes)
    chunks = (seeds[first : first + _CHUNK_EPISODES] for first in range(0, plan.episodes, _CHUNK_EPISODES))
    return [Cell(name, partial(run, chunk), cost_s * len(chunk)) for chunk in chunks]


def rows(_plan: Plan, results: Sequence[Any]) -> list[Row]:
    """A row for each case; the results stand in the order of ``cells``."""
    return [row_of(case, np.concatenate(own)) for case, own in of_cases(EFFICIENCY_CASES, results)]


def row_of(case: Case, rows: Array) -> Row:
    """The row of a case; ``rows`` has one for each of its episodes, as ``run_chunk`` returns it."""
    episodes = len(rows)
    squared, said, bound, nees = rows.mean(axis=0).tolist()
    rmse_m, bound_m = squared**0.5, bound**0.5
    low, high = chi2.ppf([0.005, 0.995], 2 * episodes) / (2 * episodes)
    excess = rows[:, 0] - squared / bound * rows[:, 2]  # both errors and bound vary with the path
    row = Row(
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
    )
    return with_limits(row, (Limit("ratio", most=_MAX_RATIO),))


def _name(case: Case) -> str:
    mesh = "at once" if case.at_once else "mesh" if case.mesh else "no mesh"
    return f"{case.noise_ps:.0f} ps, {case.random_walk_fm:.0e}, qa {case.qa:g}, {mesh}"
