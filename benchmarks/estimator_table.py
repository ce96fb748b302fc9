"""What each mechanism of the estimator buys: ``python benchmarks/estimator_table.py [--data FOLDER] [--docs FILE]``.

One mechanism at a time is switched off, by values of constants with which it does nothing, and the same receptions are
processed again: simulated rooms, the paper's lab, and recordings below ``--data``. The table has the RMSE over that
with all mechanisms on. ``--kept FILE`` keeps the sums as JSON: a run that was interrupted continues there.
``--only WORD`` takes the mechanisms that hold a word, ``--rows WORD`` the situations. ``--constants`` doubles and
halves one constant at a time instead.
"""

import argparse
import json
import multiprocessing
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs
from recorded_phases import MARGINS_S, stops_of, tracked

from skyless.core.errors import SkylessError
from skyless.core.estimator import settings as parameters
from skyless.core.site import EXACT, AccuracySite, Site
from skyless.research.benchmark import Found, recordings_below
from skyless.research.foreign import datasets as muloc
from skyless.research.replays.captures import CaptureReplay
from skyless.research.replays.options import ReplayOptions
from skyless.research.studies import room
from skyless.research.studies.picture import Case
from skyless.research.studies.runner import Plan, plan_of
from skyless.research.studies.worlds import Run, beacons_of, judged, worlds
from skyless.sim.evaluation.scenarios import Room, wanderers
from skyless.sim.impairments import AnchorBias, Body
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.sim.trajectory import Trajectory, Waypoints
from skyless.site.file.template import rectangular_site

OFF = 1e12
DIFFERENCES = "skyless.run.masterless.difference_tracking:"

MECHANISMS: dict[str, dict[str, float]] = {
    "": {},
    "Jumps of range errors": {"in_row": OFF, "in_row_where_late": OFF},
    "… widen all range errors": {"obstructed_std_m": 0.0, "obstructed_s": OFF},
    "… may still be changing": {"first_change_scale": 1.0},
    "… of more than 20 cm return slowly": {"obstruction_return_m": OFF},
    "… end where receptions are likelier without them": {"ended_log_odds": OFF},
    "Single late packets": {"late_often_share": OFF},
    "… need more in a row for a jump": {"in_row_where_late": 2},
    "… less weight of large innovations": {"reception_huber": OFF},
    "… weak first paths": {"skyless.core.air.frame:CLEAR_DB": OFF},
    "Faults are opened": {"sure_chi2": OFF},
    "… creeping ones": {"creeping_std_m": 1e-6},
    "… recent ones": {"recent_std_m": 1e-6},
    "… early ones weigh less": {"early_weight": 1.0},
    "Noise of motion adapts": {"lag_limit": OFF, "sudden_lag": OFF},
    "… at once": {"sudden_lag": OFF},
    "… slowly": {"lag_limit": OFF},
    "… to a fast tag's turns": {"walking_mps": OFF},
    "Noise of clocks adapts": {"max_walk_scale": 1.0},
    "… a step of the tag's is seen at once": {"common": OFF},
    "Jumps of pairs' paths": {"relays_in_row": OFF},
    "Reports only of steady clocks": {"steady_walk_scale": OFF},
    "A mean NIS of more than 2 is acted on": {"wrong_nis": OFF},
    "Phases are taken at several cycles": {"most_cycles": 0.0},
    "… not where they are often wild": {"most_wild": 1.0},
    "Clocks that wander little are found by their rates": {"rate_s": OFF},
    "Multipath is learnt": {"place_samples": OFF},
    "Ranges are linearised at held points": {"held_step_m": 0.0, "held_max_m": 0.0},
    "Curvature of ranges": {"curvature_share": OFF},
    "Relays survey pairs of anchors": {"pair_relays": OFF},
    "… and find misplaced anchors": {"misplaced_pairs": OFF},
    "Differences: sizes of changes adapt": {DIFFERENCES + "DIFFERENCES.change_memory_s": 0.0},
    "Differences: changes are not early": {DIFFERENCES + "DIFFERENCES.earliest_m": -OFF},
    "Differences: less weight of large innovations": {"difference_huber": OFF},
    "Differences: tags at rest": {DIFFERENCES + "DIFFERENCES.stationary_s": 0.0},
    "Differences: starts with late anchors": {"most_late": 0},
    "Start: relays may contradict it": {"max_relays_rejected": OFF},
    "Start: wide ones wait": {"start_patience_s": 0.0},
    "Start: what contradicts it": {"start_tail": 0.0},
    "Start: margin on its covariance": {"start_margin": 1.0},
    "Start: open ones stay for a second": {"new_start_s": 0.0},
    "Start: the tag's oscillator warms up": {"start_walk_scale": 1.0},
    "Start: anchors may stand elsewhere if contradicted": {"open_survey_std_m": 1e-6},
    "… and are repeated once errors fit": {"fitting_chi2": 0.0},
    "Start: no level after a contradicted one": {"max_open_level_std": OFF, "contradicted_start_s": 0.0},
    "Levels: mirror images": {"sensor_valid_s": OFF},
    "Levels: wide positions": {"curved_std": OFF},
}
"""Each mechanism, and the constants by which it does nothing: fields of ``Tuning``, or names in a module."""

ROOM = {
    "the room": "room",
    "unbiased air": "clean",
    "3-D room, 8 anchors": "3-D",
    "anchors in a line": "line",
    "at rest, later": "rest",
    "one anchor 20 cm off": "off",
    "multipath of 5 cm over 10 cm": "multipath",
    "multipath of 10 cm over 10 cm": "10 cm",
    "1 of 6 late, 0.1–0.4 m": "1 late",
    "2 of 6 late, 0.1–0.4 m, 6 s": "2 late, 6 s",
    "2 of 6 late, 0.5–2 m": "2 late, far",
    "3 of 6 late, 0.5–2 m": "3 late, far",
    "1 of 6 creeps 5 cm/s for 5 s": "creep",
    "tags' crystals +2 ppm": "crystal",
    "turns of 30 m/s² at 3 m/s": "turns",
}
LAB = {
    "nothing lost": "lab",
    "90 % lost everywhere": "90 % lost",
    "20 % late by exp(1 m)": "20 % late",
    "20 % late by exp(1 m), reported": "… reported",
    "one anchor +1.5 m in bursts": "bursts",
    "rounds at 5 m/s": "5 m/s",
}
PHASES = {
    "10 % wild": "10 % wild",
    "past a wall": "wall, phases",
    "walking, 100/s, 1e-09": "walking, 100/s",
    "hands, 400/s, 5e-09": "hands, 400/s",
}
"""Cases of the studies, and the columns' names; of those with phases."""

RECORDED = (
    "const1-trial1-tdoa2",
    "const1-trial2-tdoa3",
    "const2-trial4",
    "const3-trial8",
    "const4-trial3",
    "0425-traj6",
)
"""Recordings that the table takes: two in free space, three with obstacles, one noisier."""

START_S = 1.4
"""For which starts are judged, from power-on."""

Sums = list[list[float]]
"""A row for each tag or recording: fixes, sum of squared errors [m²], of NEES, levels, fixes beyond their level."""

BEYOND_SCATTER = 3.0
"""Standard errors, over worlds, of the mean logarithm of a ratio."""
LEAST_CHANGE = 0.02
"""Smaller changes of an RMSE are not shown."""
FEW_WORLDS_CHANGE = 0.1
"""A change that rests on few worlds is shown from here on, in brackets."""

FACTORS = ("× 2", "÷ 2")


def constants() -> dict[str, dict[str, float]]:
    """Each constant of ``Tuning`` doubled and halved; of factors near 1 their distance from that."""
    found = {}
    for name in parameters.Tuning.__annotations__:
        value = getattr(parameters.TUNING, name)
        for sign, factor in zip(FACTORS, (2.0, 0.5), strict=True):
            is_near_one = 0.9 < value < 1.3 and value != 1.0
            found[f"`{name}` {sign}"] = {name: 1.0 + factor * (value - 1.0) if is_near_one else factor * value}
    return found


def cases(seed: int, count: int) -> list[Case]:
    """The simulated columns."""
    plan = structs.replace(plan_of("joint", seed, study="room"), worlds=4 * count, tags=4, seconds=15.0)
    named = {ROOM[case.name]: case for case in room.cases(plan) if case.name in ROOM}
    plan = structs.replace(plan, worlds=count)
    with_phases = room.cases(structs.replace(plan, conditions="phase"))
    named |= {PHASES[case.name]: case for case in with_phases if case.name in PHASES}
    for conditions in ("loss", "nlos", "motion"):
        in_lab = room.cases(structs.replace(plan, conditions=conditions))
        named |= {LAB[case.name]: case for case in in_lab if case.name in LAB}
    named |= {case.name: case for case in in_both_protocols(structs.replace(plan, tags=2, seconds=12.0))}
    named |= {case.name: case for case in starts(structs.replace(plan, tags=16, seconds=START_S))}
    return [structs.replace(case, name=name, runs=case.runs[:count]) for name, case in named.items()]


def in_both_protocols(plan: Plan) -> list[Case]:
    """What goes wrong for all anchors or messages at once, with a master (1) and without (2), in the room's errors."""
    crystals = {"crystals": (100.0, 300.0, 1e4), "fast crystals": (300.0, 1000.0, 1e4), "power cut": (0.5, 3.0, 60.0)}
    faults: dict[str, dict[str, Any]] = {
        "room": {},
        **{name: {"warm_ups": partial(room.warming_anchors, plan, *of)} for name, of in crystals.items()},
        "10 % late": {"nlos": 0.1},
        "30 % late": {"nlos": 0.3},
        "wall": {"walls_between_anchors": False},
        "body": {"body": Body()},
        "carried": {"body": Body(delay_m=0.4, sector_rad=2.4)},
        "drifts off": {"biases": drifting_anchor},
    }
    found = []
    for protocol, site in ((1, paper_lab_site(plan.noise_ps, AccuracySite())), (2, lab_site(plan.noise_ps))):
        walled = structs.replace(site, walls=(room.WALL,))
        for name, more in faults.items():
            paths = partial(room.past_wall, plan.tags) if name == "wall" else partial(wanderers, site, plan.tags)
            runs = worlds(plan, walled if name == "wall" else site, paths, room=Room(), warmup_s=1.5, **more)
            found.append(Case(f"{name} ({protocol})", "both protocols", None, runs))
    return found


def drifting_anchor(number: int) -> tuple[AnchorBias, ...]:
    """An anchor whose range error grows by 1 to 5 m/s for a second, and then stays."""
    creep_mps = (1.0, 2.0, 5.0)[number % 3]
    return (
        AnchorBias(number % 6 + 1, 0.0, from_s=5.0, to_s=6.0, creep_mps=creep_mps),
        AnchorBias(number % 6 + 1, creep_mps, from_s=6.0, to_s=np.inf),
    )


def starts(plan: Plan) -> list[Case]:
    """The first seconds after power-on: in the room, past late anchors, among lost packets, of fast tags, in a hall."""
    lab, hall = lab_site(plan.noise_ps), structs.replace(rectangular_site(30.0, 20.0, 8, 4.0, None), accuracy=EXACT)
    wide = structs.replace(
        lab, anchors=tuple(structs.replace(one, x_m=5.0 * one.x_m, y_m=5.0 * one.y_m) for one in lab.anchors)
    )
    late, soon = (partial(room.late_anchors, plan, 2, (0.5, 2.0), 0.0, until_s) for until_s in (np.inf, 1.0))
    some: dict[str, tuple[Site, Callable[..., Any], dict[str, Any]]] = {
        "start": (lab, wanderers, {"room": Room()}),
        "start, 2 late": (lab, wanderers, {"room": Room(), "biases": late}),
        "start, 80 % lost": (lab, wanderers, {"lost_at_tags": 0.8}),
        "start in a hall": (wide, wanderers, {}),
        "late for 1 s": (lab, wanderers, {"room": Room(), "biases": soon, "warmup_s": 5.0, "seconds": 5.0}),
        "start at 5 m/s": (hall, partial(straight, speed_mps=5.0), {}),
        "start at 20 m/s": (hall, partial(straight, speed_mps=20.0), {}),
    }
    return [
        Case(name, "starts", None, worlds(plan, site, partial(paths, site, plan.tags), **{"warmup_s": 0.0, **more}))
        for name, (site, paths, more) in some.items()
    ]


def straight(_: Site, tags: int, seed: int, speed_mps: float) -> list[Trajectory]:
    """Tags that drive through the hall, each along its own line."""
    draw = np.random.default_rng(seed)
    away_m = speed_mps * START_S / 2.0 + 0.5
    lines = [(draw.uniform(2.0, 18.0), draw.uniform(0.5, 2.5)) for _ in range(tags)]
    middles_m = draw.uniform(min(away_m, 15.0), max(30.0 - away_m, 15.0), tags)
    return [
        Waypoints([(max(x_m - away_m, 0.5), y_m, z_m), (min(x_m + away_m, 29.5), y_m, z_m)], speed_mps)
        for x_m, (y_m, z_m) in zip(middles_m, lines, strict=True)
    ]


@contextmanager
def switched(changes: dict[str, float]) -> Iterator[None]:
    """Let constants have other values within the block, in every module that has imported them."""
    tuned = {name: value for name, value in changes.items() if ":" not in name}
    new: dict[str, Any] = {"TUNING": parameters.TUNING.changed(**tuned)}
    for place, value in changes.items():
        module, _, attribute = place.rpartition(":")
        if module:
            name, _, field = attribute.partition(".")
            new[name] = getattr(import_module(module), name).changed(**{field: value}) if field else value
    modules = [module for name, module in sys.modules.items() if name.startswith("skyless.")]
    undo = [(module, name, vars(module)[name]) for module in modules for name in new if name in vars(module)]
    for module, name, _ in undo:
        setattr(module, name, new[name])
    try:
        yield
    finally:
        for module, name, value in undo:
            setattr(module, name, value)


def simulated(run: Run, mechanisms: dict[str, dict[str, float]]) -> dict[str, Sums]:
    """Sums over the fixes of each tag of a world, with each mechanism off."""
    tape, found = list(beacons_of(run)), {}
    alone = [
        [structs.replace(one, receptions=[heard for heard in one.receptions if heard[0] == tag]) for one in tape]
        for tag in range(len(run.trajectories))
    ]
    for name, changes in mechanisms.items():
        with switched(changes):
            results = [judged(run, of_tag) for of_tag in alone]
        found[name] = []
        for one in results:
            levels = (0.0, 0.0) if one.levels is None else (one.levels.levels.sum(), one.levels.exceeded.sum())
            found[name].append([float(value) for value in (one.fixes, one.squared_m2, one.nees, *levels)])
    return found


def sums_of(error_m: np.ndarray, covariances_m2: np.ndarray, levels_m: np.ndarray) -> list[float]:
    """The same of fixes: errors, shape (n, dim), their covariances, and horizontal levels."""
    nees = np.einsum("ni,nij,nj->", error_m, np.linalg.inv(covariances_m2), error_m) / error_m.shape[1]
    exceeded = (np.hypot(error_m[:, 0], error_m[:, 1]) > levels_m).sum()
    return [float(one) for one in (len(error_m), (error_m**2).sum(), nees, np.isfinite(levels_m).sum(), exceeded)]


def recorded(found: Found, first_s: float, mechanisms: dict[str, dict[str, float]]) -> dict[str, Sums]:
    """The same of a recording."""
    sums = {}
    options = ReplayOptions(
        found.path, anchors=found.anchors, truth=found.truth, lever_arm_m=(-0.01245, 0.00127, 0.0908),
        uncalibrated=True, first_s=first_s,
    )  # fmt: skip
    for name, changes in mechanisms.items():
        with switched(changes):
            run = CaptureReplay(options)
            run.run(None, lambda _: None)
            table, (truth_m, is_judged) = run.samples.table(), run.judged.of(run.samples.table().time_s)
        error_m = (table.position_m - truth_m)[is_judged]
        sums[name] = [sums_of(error_m, table.covariance_m2[is_judged], table.levels_m[is_judged, 0])]
    return sums


def packets(path: Path, channel: int, has_phases: bool, mechanisms: dict[str, dict[str, float]]) -> dict[str, Sums]:
    """The same of MULoc's packets of one channel, at each of its stops."""
    sums = {}
    for name, changes in mechanisms.items():
        with switched(changes):
            rows, sums[name] = tracked(path, channel, has_phases=has_phases), []
        for begin_s, end_s, place_m in stops_of(path):
            own = rows[(rows[:, 0] >= begin_s + MARGINS_S[0]) & (rows[:, 0] <= end_s - MARGINS_S[1])]
            sums[name].append(sums_of(own[:, 1:3] - place_m, own[:, 3:7].reshape(-1, 2, 2), own[:, 7]))
    return sums


def call(cell: tuple[str, Callable[[], dict[str, Sums]]]) -> tuple[str, dict[str, Sums]]:
    """The work of one process."""
    name, function = cell
    return name, function()


Column = dict[str, list[np.ndarray]]
"""Of each mechanism the sums of each world, shape (tags, 5)."""


def markdown(columns: dict[str, Column]) -> str:
    """Two tables: everything on, and what changes beyond the scatter of worlds with each mechanism off."""
    lines = ["| | RMSE | worst tag | NEES | levels | exceeded |", "|---|---|---|---|---|---|"]
    for name, column in columns.items():
        tags = np.concatenate(column[""])
        fixes, squared_m2, nees, levels, exceeded = tags.sum(axis=0)
        worst_cm = 100.0 * np.max(np.sqrt(tags[:, 1] / np.maximum(tags[:, 0], 1.0)))
        lines.append(
            f"| {name} | {100.0 * (squared_m2 / fixes) ** 0.5:.2f} cm | {worst_cm:.1f} cm | {nees / fixes:.2f} "
            f"| {100.0 * levels / fixes:.0f} % | {exceeded:.0f} |"
        )
    names = [name for name in next(iter(columns.values())) if name]
    if names and all(name.endswith(FACTORS) for name in names):
        lines += ["", f"| constant | {' | '.join(FACTORS)} |", "|---|---|---|"]
        idle = []
        for name in sorted({name.rpartition("`")[0] for name in names}):
            both = [changes(columns, f"{name}` {factor}") for factor in FACTORS]
            if set(both) == {"nothing"}:
                idle.append(f"{name}`")
            else:
                lines.append(f"| {name}` | {' | '.join(both)} |")
        lines += ["", f"Nothing beyond the scatter in these situations: {', '.join(idle) or 'none'}."]
    elif names:
        lines += ["", "| off | what changes |", "|---|---|"]
        lines += [f"| {name} | {changes(columns, name)} |" for name in names]
    return "\n".join(lines) + "\n"


def changes(columns: dict[str, Column], name: str) -> str:
    """What a mechanism changes in all columns."""
    found = ((column, changed(by_name[""], by_name[name])) for column, by_name in columns.items())
    return "; ".join(f"{column} {text}" for column, text in found if text) or "nothing"


def changed(on: list[np.ndarray], off: list[np.ndarray]) -> str:
    """What a mechanism changes in a column, empty where that is nothing beyond the scatter of worlds."""
    worlds_on, worlds_off = (np.array([world.sum(axis=0) for world in side]) for side in (on, off))
    fixes_on, squared_on, nees_on, levels_on, exceeded_on = worlds_on.sum(axis=0)
    fixes_off, squared_off, nees_off, levels_off, exceeded_off = worlds_off.sum(axis=0)
    if not fixes_on or not fixes_off:
        return "" if fixes_on == fixes_off else "no fix" if fixes_on else "fixes"
    ratio, parts = ((squared_off / fixes_off) / (squared_on / fixes_on)) ** 0.5, []
    both = (worlds_on[:, 0] > 0.0) & (worlds_off[:, 0] > 0.0)
    one, other = worlds_on[both], worlds_off[both]
    logs = 0.5 * np.log((other[:, 1] / other[:, 0]) / (one[:, 1] / one[:, 0]))
    error = np.std(logs, ddof=1) / len(logs) ** 0.5 if len(logs) > 1 else 0.0
    if abs(ratio - 1.0) >= LEAST_CHANGE and abs(np.mean(logs)) > BEYOND_SCATTER * error:
        parts.append(f"{ratio:.2f}")
    elif abs(ratio - 1.0) >= FEW_WORLDS_CHANGE:
        parts.append(f"({ratio:.2f})")
    if abs(fixes_off / fixes_on - 1.0) >= LEAST_CHANGE:
        parts.append(f"{100.0 * (fixes_off / fixes_on - 1.0):+.0f} % fixes")
    if nees_off / fixes_off > max(1.5 * nees_on / fixes_on, 1.3):
        parts.append(f"NEES {nees_off / fixes_off:.1f}")
    if abs(levels_off / fixes_off - levels_on / fixes_on) > 0.05:
        parts.append(f"levels {100.0 * levels_off / fixes_off:.0f} %")
    if exceeded_off != exceeded_on:
        parts.append(f"**{exceeded_off - exceeded_on:+.0f} exceeded**")
    return ", ".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--worlds", type=int, default=2, help="of each simulated situation")
    parser.add_argument("--data", type=Path, help="folder of recordings")
    parser.add_argument("--first", type=float, default=60.0, help="seconds of each recording")
    parser.add_argument("--rows", nargs="*", default=[""])
    parser.add_argument("--only", nargs="*", default=[""])
    parser.add_argument("--kept", type=Path, help="file in which the sums are kept")
    parser.add_argument("--docs", type=Path, help="page whose part behind <!-- table --> is replaced")
    parser.add_argument("--constants", action="store_true", help="each constant doubled and halved, instead")
    asked = parser.parse_args()
    known = {"": {}, **constants()} if asked.constants else MECHANISMS
    chosen = {name: off for name, off in known.items() if not name or any(word in name for word in asked.only)}
    cells = [
        (case.name, partial(simulated, run, chosen)) for case in cases(asked.seed, asked.worlds) for run in case.runs
    ]
    below = (
        [(name, found) for found in recordings_below(asked.data) for name in RECORDED if name in found.name]
        if asked.data
        else []
    )
    cells += [(name, partial(recorded, found, asked.first, chosen)) for name, found in below]
    for path in sorted(asked.data.glob("muloc/*.npz")) if asked.data else []:
        for channel in muloc.CHANNELS:
            for has_phases in (False, True):
                name = f"MULoc {channel}, {'phases' if has_phases else 'stamps'}"
                cells.append((name, partial(packets, path, channel, has_phases, chosen)))
    cells = [cell for cell in cells if any(word in cell[0] for word in asked.rows)]
    if not cells:
        parser.error(f"--rows is {' '.join(asked.rows)}; it should be words of situations, as the tables list them")
    amounts = [asked.seed, asked.worlds, asked.first, *chosen]
    kept: list[tuple[str, dict[str, Sums]]] = []
    if asked.kept and asked.kept.exists():
        of, kept = json.loads(asked.kept.read_text())
        if of != amounts:
            parser.error(f"--kept {asked.kept} is of another seed, amount or choice of mechanisms: name another file")
    before = [name for name, _ in kept]
    todo = [cell for cell in cells if cell[0] not in before or before.remove(cell[0])]
    with multiprocessing.Pool() as pool:
        for name, sums in pool.imap_unordered(call, todo, 1):
            kept.append((name, sums))
            if asked.kept:
                asked.kept.write_text(json.dumps([amounts, kept]))
            print(f"{len(kept)} of {len(cells)}: {name}", file=sys.stderr, flush=True)
    columns: dict[str, Column] = {name: {} for name, _ in cells}
    for name, sums in kept:
        for mechanism, values in sums.items():
            columns[name].setdefault(mechanism, []).append(np.array(values))
    text = markdown(columns)
    print(text)
    if asked.docs:
        mark = "<!-- constants -->" if asked.constants else "<!-- table -->"
        before, _, behind = asked.docs.read_text().partition(mark)
        _, end, rest = behind.partition("<!-- end -->")
        asked.docs.write_text(f"{before}{mark}\n\n{text}\n{end}{rest}")


if __name__ == "__main__":
    try:
        main()
    except SkylessError as error:
        sys.exit(str(error))
