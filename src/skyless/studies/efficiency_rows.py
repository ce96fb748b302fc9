"""The study ``efficiency``: matched episodes of the filter itself, shared out in cells, and their rows."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from skyless.errors import SkylessError
from skyless.kernels.arrays import Array
from skyless.studies.efficiency import CHUNK, run_chunk, summary
from skyless.studies.episodes import Case
from skyless.studies.plan import Cell, Plan, Row

LIMIT: Final = 1.02
EPISODE_S: Final = 0.02
"""About what an episode and its bounds take."""

NOISES_PS: Final = (100.0, 150.0)
WALKS: Final = (1e-9, 1e-8)
AGILITIES: Final = (0.5, 2.0)
MESHES: Final = ((False, False), (True, False), (True, True))
"""Without; relayed with an anchor's next frame; known at once."""

CASES: Final = tuple(
    Case(noise_ps, walk, qa, mesh, at_once)
    for mesh, at_once in MESHES
    for noise_ps in NOISES_PS
    for walk in WALKS
    for qa in AGILITIES
)


def cells(plan: Plan) -> list[Cell]:
    """Episodes in chunks.

    Raises:
        SkylessError: the method is not one that can be fed with an episode's stamps.
    """
    if plan.method != "joint":
        raise SkylessError(f"--method is {plan.method!r}; the study efficiency is of joint, whose bound it computes")
    return [
        Cell(_name(case), _run, (case, tuple(seeds[first : first + CHUNK])), EPISODE_S * CHUNK)
        for case in CASES
        for seeds in [np.random.SeedSequence(plan.seed).spawn(plan.episodes)]
        for first in range(0, plan.episodes, CHUNK)
    ]


def _run(chunk: tuple[Case, tuple[np.random.SeedSequence, ...]]) -> Array:
    case, seeds = chunk
    return run_chunk(case, list(seeds))


def rows(plan: Plan, results: Sequence[Any]) -> list[Row]:
    """A row for each case; the results stand in the order of ``cells``."""
    each = -(-plan.episodes // CHUNK)
    return [
        _row(case, np.concatenate(results[each * number : each * (number + 1)])) for number, case in enumerate(CASES)
    ]


def _row(case: Case, episodes: Array) -> Row:
    told = summary(case, episodes)
    low, high = told.nees_interval
    return Row(
        study="efficiency",
        method="joint",
        case=_name(case),
        series="at once" if case.at_once else "with mesh" if case.mesh else "without mesh",
        x=None,
        mesh=case.mesh,
        noise_ps=case.noise_ps,
        runs=told.episodes,
        fixes=told.episodes,
        rmse_m=told.rmse_m,
        rmse_error_m=float(episodes[:, 0].std() / np.sqrt(len(episodes)) / (2.0 * told.rmse_m)),
        said_m=told.said_m,
        nees=told.nees / 2.0,
        nees_interval=(low / 2.0, high / 2.0),
        bound_m=told.arrived_bound_m,
        ratio=told.ratio,
        ratio_error=told.ratio_error,
        limit=LIMIT,
        passed=told.ratio <= LIMIT,
    )


def _name(case: Case) -> str:
    mesh = "at once" if case.at_once else "mesh" if case.mesh else "no mesh"
    return f"{case.noise_ps:.0f} ps, {case.random_walk_fm:.0e}, qa {case.qa:g}, {mesh}"
