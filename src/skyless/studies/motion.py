"""How the error grows with speed and turns; fixes are judged when they are made."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np

from skyless.simulation.trajectory import Trajectory
from skyless.studies import motions
from skyless.studies.lab_setup import box, hall_site, worlds
from skyless.studies.plan import Plan
from skyless.studies.summary import Case

ACCELERATION_MPS2: Final = 3.0
STILL: Final = "still"


def cases(plan: Plan) -> list[Case]:
    """Still, rounds at three speeds, zigzags, stop and go, all in the hall."""
    site = hall_site(plan.noise_ps)
    low_m, high_m = box(site)

    def paths(kind: Callable[..., Trajectory], seed: int) -> Sequence[Trajectory]:
        draw = np.random.default_rng(seed)
        return [kind(draw, low_m, high_m) for _ in range(plan.tags)]

    def moving(kind: Callable[..., Trajectory], speed_mps: float) -> Callable[..., Trajectory]:
        return partial(kind, speed_mps=speed_mps, acceleration_mps2=ACCELERATION_MPS2)

    kinds = {
        STILL: motions.still,
        "rounds at 1 m/s": moving(motions.rounds, 1.0),
        "rounds at 3 m/s": moving(motions.rounds, 3.0),
        "rounds at 5 m/s": moving(motions.rounds, 5.0),
        "zigzag at 3 m/s": moving(motions.zigzag, 3.0),
        "stop and go, 3 m/s": moving(motions.stop_and_go, 3.0),
        "stop and go, 5 m/s": moving(motions.stop_and_go, 5.0),
    }
    return [Case(name, "motion", None, worlds(plan, site, partial(paths, kind)), STILL) for name, kind in kinds.items()]
