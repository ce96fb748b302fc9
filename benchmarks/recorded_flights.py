"""``skyless replay`` on recordings with a truth, beside a plain filter, all with one setting.

    python benchmarks/recorded_flights.py [FOLDER] [--calibrated] [--only TEXT] [--method NAME] [--json]

FOLDER holds the recordings (default: SKYLESS_DATA, else ../shared/data). Flights are judged as ``skyless replay
--truth`` judges them: from three seconds after the first record on, more than 0.3 m above the floor, the truth carried
to the antenna.

Columns: fixes for each difference in the judged time (a difference that is refused makes none); RMSE; that of the plain
filter (``plain_flight_filter.py``); their ratio; mean of the squared error over the claimed covariance (NEES) by degree
of freedom; share of fixes beyond the 99.99 % ellipsoid of their covariance, and the largest error there; fixes with a
protection level, of all with a truth, and how many exceed it horizontally and vertically; fixes of the first seconds
more than 0.5 m off that claim σ < 0.25 m or give a level; seconds with an error above 1 m and above four times the
claimed standard deviation, the root of the covariance's trace. ``--calibrated`` replays flights also with
what ``skyless survey`` finds on trial 1 of their constellation and system. The last table has recordings of packets,
judged in 2-D: a tag at rest at a place that nobody documented (Kuipman), and anchors that play the tag, placed by their
own two-way ranging (Avalue).
"""

import argparse
import json
import os
import re
from collections import Counter
from pathlib import Path

import msgspec
import numpy as np
from plain_flight_filter import plain_positions
from scipy.stats import chi2

from skyless.research.calibration.biases import biases_of
from skyless.research.calibration.options import SurveyOptions
from skyless.research.foreign.avalue import anchor_distances_m
from skyless.research.foreign.formats import format_of, open_recording
from skyless.research.replays.captures import CaptureReplay
from skyless.research.replays.inputs import flight_height, height_to_hold, known_anchors, known_truth
from skyless.research.replays.options import ReplayOptions
from skyless.sim.evaluation.judge import Judge

LEVER_ARM = (-0.01245, 0.00127, 0.0908)
"""Of the antenna in the body of the UTIL drone, metres."""

KUIPMAN_M = (2.0, 3.0)
"""Place of the tag as the capture's own script has it."""

SETTLE_FLIGHT_S, SETTLE_REST_S = 3.0, 2.0
"""What ``skyless replay`` does not judge, with and without a table of truth."""

INSIDE = 0.9999
START_M, START_STD_M = 0.5, 0.25
"""A start that is farther off should claim neither a smaller standard deviation nor a level."""

BLUNDER_M = 1.0
BLUNDER_STD = 4.0
LONGEST_GAP_S = 1.0
"""Truth with longer gaps is none, as ``Judge`` has it."""

LONGEST_HOLD_S = 0.1
"""A fix counts until the next one, and so long at most."""

SPEED_OVER_S = 0.1
"""The plain filter starts at the truth; its velocity is that of the truth over so long."""

DIVERGED_M = 1.0
"""A plain filter with a larger error has lost the tag: no ratio is made with it."""

WORSE = (1.10, 1.25)


class Recording(msgspec.Struct, frozen=True):
    """A table of differences with its truth."""

    name: str
    group: str
    """Of summaries: flights or logs."""
    trained_by: str
    """Recordings that share a calibration share this; empty where there is none."""
    tdoa: Path
    truth: Path
    anchors: Path


class Score(msgspec.Struct, frozen=True):
    """What fixes came to; metres and seconds, None where it cannot be told."""

    fixes: int
    rmse_2d_m: float | None
    rmse_3d_m: float | None
    nees_per_dof: float | None
    beyond: float | None
    beyond_max_m: float | None
    levels: int
    """Fixes with a level, from the first one on, ..."""
    exceeded_horizontal: int
    exceeded_vertical: int
    exceeded_unalerted: int
    bad_starts: int
    """Fixes of the first seconds that are too far off for what they claim."""
    blunders_s: float


class Row(msgspec.Struct, frozen=True):
    """A recording's line of the table."""

    name: str
    group: str
    available: float
    """Fixes for each difference that could be judged."""
    score: Score
    plain_2d_m: float
    plain_3d_m: float

    @property
    def plain_diverged(self):
        return not self.plain_3d_m < DIVERGED_M

    @property
    def ratio_2d(self):
        return None if self.plain_diverged or self.score.fixes == 0 else self.score.rmse_2d_m / self.plain_2d_m

    @property
    def ratio_3d(self):
        return None if self.plain_diverged or self.score.rmse_3d_m is None else self.score.rmse_3d_m / self.plain_3d_m


class Keeper(Judge):
    """The judge of ``skyless replay``, which also keeps the times of the positions that it is shown."""

    def __init__(self, truth, **options):
        super().__init__(truth, **options)
        self.times_s, self.since_s = [], []

    def add(self, time_s, since_start_s, position_m):
        super().add(time_s, since_start_s, position_m)
        self.times_s.append(time_s)
        self.since_s.append(since_start_s)


class Fixes:
    """What fixes say, as arrays; NaN for what they do not say."""

    def __init__(self):
        self._rows, self._alerts = [], []

    def add(self, fix):
        covariance, *levels, alert = (getattr(fix, name, None) for name in ("covariance_m2", "hpl_m", "vpl_m", "alert"))
        levels = (np.nan if level is None else level for level in levels)
        self._rows.append((*fix.position_m, *(np.full(9, np.nan) if covariance is None else covariance.flat), *levels))
        self._alerts.append(alert is not None and str(alert) != "none")

    def arrays(self):
        """Positions (n, 3), covariances (n, 3, 3), levels (n, 2), and whether each carries an alert (n,)."""
        rows = np.array(self._rows).reshape(-1, 14)
        return rows[:, :3], rows[:, 3:12].reshape(-1, 3, 3), rows[:, 12:], np.array(self._alerts, dtype=bool)


def score(times_s, error_m, covariance_m2, levels_m, alerted, here):
    """Judge fixes; errors are of shape (n, 2) where the height was given or is unknown, else (n, 3); NaN: no truth.

    Accuracy counts where ``here`` is true, levels from the first one on, as the worst starts are before that.
    """
    known, dim = np.isfinite(error_m[:, 0]), error_m.shape[1]
    has_level = known & np.isfinite(levels_m[:, 0])
    horizontal = has_level & (np.hypot(error_m[:, 0], error_m[:, 1]) > levels_m[:, 0])
    vertical = has_level & (np.abs(error_m[:, 2]) > levels_m[:, 1]) if dim == 3 else np.zeros_like(has_level)
    covariance_m2 = covariance_m2[:, :dim, :dim]
    claimed = has_level | (np.trace(covariance_m2, axis1=1, axis2=2) < START_STD_M**2)
    is_start = known & (times_s < times_s[:1] + SETTLE_FLIGHT_S)
    of_levels = {
        "levels": int(has_level.sum()),
        "exceeded_horizontal": int(horizontal.sum()),
        "exceeded_vertical": int(vertical.sum()),
        "exceeded_unalerted": int(((horizontal | vertical) & ~alerted).sum()),
        "bad_starts": int((is_start & claimed & ((error_m**2).sum(axis=1) > START_M**2)).sum()),
    }
    times_s, error_m, covariance_m2 = times_s[here], error_m[here], covariance_m2[here]
    count = len(error_m)
    if count == 0:
        return Score(0, None, None, None, None, None, **of_levels, blunders_s=0.0)
    squared_m2 = (error_m**2).sum(axis=1)
    told = np.isfinite(covariance_m2).all(axis=(1, 2))
    told[told] = np.linalg.det(covariance_m2[told]) > 0.0
    whitened = np.linalg.solve(covariance_m2[told], error_m[told][..., None])[..., 0]
    nees = (error_m[told] * whitened).sum(axis=1)
    beyond = nees > chi2.ppf(INSIDE, dim)
    hold_s = np.minimum(np.diff(times_s, append=times_s[-1]), LONGEST_HOLD_S)
    with np.errstate(invalid="ignore"):
        blunder = squared_m2 > np.maximum(BLUNDER_M**2, BLUNDER_STD**2 * np.trace(covariance_m2, axis1=1, axis2=2))
    return Score(
        fixes=count,
        rmse_2d_m=float(np.sqrt(squared_m2.mean() - (error_m[:, 2:] ** 2).sum() / count)),
        rmse_3d_m=float(np.sqrt(squared_m2.mean())) if dim == 3 else None,
        nees_per_dof=float(nees.mean() / dim) if len(nees) else None,
        beyond=float(beyond.mean()) if len(nees) else None,
        beyond_max_m=float(np.sqrt(squared_m2[told][beyond].max())) if beyond.any() else None,
        **of_levels,
        blunders_s=float(hold_s[blunder].sum()),
    )


def recordings_in(folder):
    """All flights and logs with a truth and a table of anchors, by name."""
    found = []
    for tdoa in sorted([*folder.glob("util_flights/*/*_tdoa.csv*"), *folder.glob("util_sdlogs/csv/*/*_tdoa.csv*")]):
        name, day = tdoa.name.split("_tdoa.csv")[0], tdoa.parent.name
        flight = "util_flights" in tdoa.parts
        truth = tdoa.with_name(tdoa.name.replace("_tdoa.", "_pose."))
        base = folder / ("util_flights" if flight else "util_sdlogs/anchors") / f"anchors_{day}.csv"
        system = re.search(r"tdoa\d", name)
        trained_by = f"{day}-{system[0]}" if flight and system else ""
        if truth.exists() and base.exists():
            found.append(Recording(name, "flights" if flight else "logs", trained_by, tdoa, truth, base))
    return found


def replayed(asked, calibration=None):
    """Replay as the command does; the judge, the report, and everything that fixes said."""
    fixes, run = Fixes(), CaptureReplay(asked, calibration, Keeper)
    return run.judge, run.run(fixes.add, lambda _: None), fixes.arrays()


def options_of(recording):
    """A replay of a flight or log with its truth."""
    return ReplayOptions(
        recording.tdoa,
        anchors=known_anchors(recording.anchors, None)[0],
        truth=recording.truth,
        lever_arm_m=LEVER_ARM,
        settle_s=SETTLE_FLIGHT_S,
    )


def known(recording):
    """Anchors, truth, height that is given (or None) with its σ, and height above which it is judged."""
    places, _ = known_anchors(recording.anchors, None)
    truth = known_truth(recording.tdoa, options_of(recording))
    *height, _ = height_to_hold("auto", places, None, truth, format_of(recording.tdoa).name)
    return places, truth, height, flight_height(None, truth)


def truth_at(truth, above_m, times_s):
    """True positions by linear interpolation, shape (n, 3), NaN where there are none; and which are high enough."""
    times_s, known_s = np.asarray(times_s, dtype=np.float64), truth.t_s
    places_m = np.column_stack([np.interp(times_s, known_s, axis, np.nan, np.nan) for axis in truth.position_m.T])
    after = np.clip(np.searchsorted(known_s, times_s, side="right"), 1, len(known_s) - 1)
    places_m[known_s[after] - known_s[after - 1] > LONGEST_GAP_S] = np.nan
    return places_m, places_m[:, 2] > (-np.inf if above_m is None else above_m)


def judged(recording, calibration=None):
    """Score of a recording's replay."""
    _, truth, height, above_m = known(recording)
    judge, _, (position_m, covariance_m2, levels_m, alerted) = replayed(options_of(recording), calibration)
    true_m, here = truth_at(truth, above_m, judge.times_s)
    here &= np.array(judge.since_s) >= SETTLE_FLIGHT_S
    error_m = (position_m - true_m)[:, : 2 if height[0] is not None else 3]
    return score(np.array(judge.times_s), error_m, covariance_m2, levels_m, alerted, here)


def plain_of(recording):
    """RMSE of the plain filter, 2-D and 3-D, and how many differences could be judged."""
    places, truth, _, above_m = known(recording)
    with open_recording(recording.tdoa) as records:
        rows = [(one.time_s, one.tdoa_m, *places[one.anchor_a], *places[one.anchor_b]) for one in records]
    table = np.array(rows)
    true_m, here = truth_at(truth, above_m, table[:, 0])
    first = int(np.argmax(np.isfinite(true_m[:, 0])))
    start_s = table[first, 0]
    (start_m, soon_m), _ = truth_at(truth, None, [start_s, start_s + SPEED_OVER_S])
    columns = (np.ascontiguousarray(table[first:, part]) for part in (0, slice(2, 5), slice(5, 8), 1))
    position_m, _ = plain_positions(*columns, start_m, np.nan_to_num((soon_m - start_m) / SPEED_OVER_S))
    here = (here & (table[:, 0] - table[0, 0] >= SETTLE_FLIGHT_S))[first:]
    mean_squares = np.mean((position_m - true_m[first:])[here] ** 2, axis=0)
    return float(np.sqrt(mean_squares[:2].sum())), float(np.sqrt(mean_squares.sum())), int(here.sum())


def calibrations_of(recordings):
    """What ``skyless survey`` finds on trial 1, by ``trained_by``; and the names of those trials."""
    found, trained_on = {}, set()
    for recording in recordings:
        if recording.trained_by and recording.trained_by not in found and "-trial1-" in f"{recording.name}-":
            places, truth, _, above_m = known(recording)
            rows = np.column_stack([truth.t_s, truth.position_m])
            asked = SurveyOptions(recording=recording.tdoa, truth=rows, above_m=above_m, anchors=places)
            found[recording.trained_by] = biases_of(asked).estimate.calibration()
            trained_on.add(recording.name)
    return found, trained_on


def summary(rows):
    """Geometric means of the ratios and what else sums up a table."""
    told = {"recordings": len(rows), "plain_diverged": sum(row.plain_diverged for row in rows)}
    for name in ("ratio_2d", "ratio_3d"):
        ratios = np.array([getattr(row, name) for row in rows if getattr(row, name) is not None])
        told[f"{name}_geometric_mean"] = float(np.exp(np.log(ratios).mean())) if len(ratios) else None
        told |= {f"{name}_above_{limit:.2f}": int((ratios > limit).sum()) for limit in WORSE}
    nees = [row.score.nees_per_dof for row in rows if row.score.nees_per_dof is not None]
    told |= {"nees_median": float(np.median(nees)) if nees else None, "nees_max": max(nees, default=None)}
    counts = "exceeded_horizontal", "exceeded_vertical", "exceeded_unalerted", "bad_starts", "blunders_s"
    for name in ("fixes", "levels", *counts):
        told[name] = sum(getattr(row.score, name) for row in rows)
    return told


class Packets(msgspec.Struct, frozen=True):
    """A recording of packets and where its tag was."""

    name: str
    path: Path
    anchors_m: dict[int, tuple[float, float, float]]
    true_m: tuple[float, float]
    height: float | str = "auto"
    listener: str | None = None


def packets_in(folder):
    """Captures of Bitcraze's anchors, and Avalue's with each anchor as the tag."""
    kuipman = folder / "kuipman_tdoa3_sniffer"
    for path in sorted(kuipman.glob("raw_yaml/*.yaml")):
        yield Packets(f"Kuipman {path.stem[:7]}", path, known_anchors(kuipman / "anchors.csv", None)[0], KUIPMAN_M)
    for path in sorted(folder.glob("nozomi_rtls/avalue_*/ccp.csv")):
        places = placed(anchor_distances_m(path, Counter()))
        for tag, (x_m, y_m, z_m) in places.items():
            others = {anchor: place for anchor, place in places.items() if anchor != tag}
            name = f"{path.parent.name} {tag & 0xFF:X}"
            yield Packets(name, path, others, (x_m, y_m), z_m, f"{tag:X}")


def placed(distances_m):
    """Places of four nodes, or more, whose distances are known, in axes of their own (classical scaling)."""
    names = sorted({name for pair in distances_m for name in pair})
    squared_m2 = np.zeros((len(names), len(names)))
    for (a, b), metres in distances_m.items():
        i, j = names.index(a), names.index(b)
        squared_m2[i, j] = squared_m2[j, i] = metres**2
    centred = np.eye(len(names)) - 1.0 / len(names)
    values, vectors = np.linalg.eigh(-0.5 * centred @ squared_m2 @ centred)
    places_m = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, :-4:-1]
    return {name: tuple(place) for name, place in zip(names, places_m.tolist(), strict=True)}


def packets_judged(one, measurements):
    """Score of a recording of packets, the report, and the mean error."""
    asked = ReplayOptions(
        one.path,
        anchors=one.anchors_m,
        tag_height_m=one.height,
        settle_s=SETTLE_REST_S,
        measurements=measurements,
        listener=one.listener,
    )
    judge, report, (position_m, covariance_m2, levels_m, alerted) = replayed(asked)
    here = np.array(judge.since_s) >= SETTLE_REST_S
    scored = score(np.array(judge.times_s), position_m[:, :2] - one.true_m, covariance_m2, levels_m, alerted, here)
    told = {
        "name": one.name,
        "measurements": report.measurements,
        "reason": report.reason,
        **msgspec.to_builtins(scored),
    }
    std_m = np.sqrt(np.trace(covariance_m2[here][:, :2, :2], axis1=1, axis2=2)) if here.any() else np.array([])
    return told | {
        "median_m": np.median(position_m[here, :2], axis=0).tolist() if here.any() else None,
        "claimed_m": float(np.median(std_m)) if len(std_m) else None,
        "hpl_m": float(np.nanmedian(levels_m[here, 0])) if scored.levels else None,
    }


def line(*fields):
    print("| " + " | ".join(fields) + " |", flush=True)


def heading(*names):
    line(*names)
    line(*["---"] * len(names))


def number(value, form):
    return "–" if value is None else format(value, form)


def honesty(found):
    """Fields that all tables have."""
    beyond = "–" if found.beyond is None else f"{100 * found.beyond:.2f} %"
    worst = "" if found.beyond_max_m is None else f", {found.beyond_max_m:.2f}"
    return (
        number(found.nees_per_dof, ".2f"),
        beyond + worst,
        str(found.levels),
        f"{found.exceeded_horizontal} / {found.exceeded_vertical}",
        str(found.bad_starts),
        f"{found.blunders_s:.1f}",
    )


def show_row(row):
    scored = row.score
    line(
        row.name,
        f"{100 * row.available:.0f} %",
        f"{number(scored.rmse_2d_m, '.3f')} / {number(scored.rmse_3d_m, '.3f')}",
        f"{row.plain_2d_m:.3f} / {row.plain_3d_m:.3f}",
        f"{number(row.ratio_2d, '.2f')} / {number(row.ratio_3d, '.2f')}",
        *honesty(scored),
    )


def show_summary(name, told):
    worse = ", ".join(f"{told[f'ratio_2d_above_{w:.2f}']} / {told[f'ratio_3d_above_{w:.2f}']} above {w}" for w in WORSE)
    ratios = " / ".join(number(told[f"ratio_{dim}_geometric_mean"], ".3f") for dim in ("2d", "3d"))
    print(
        f"{name}: {told['recordings']} recordings; geometric mean ratio 2-D / 3-D {ratios} ({worse}; plain diverged on "
        f"{told['plain_diverged']}); NEES/dof median {number(told['nees_median'], '.2f')}, max "
        f"{number(told['nees_max'], '.2f')}; {told['levels']} levels, exceeded horizontally in "
        f"{told['exceeded_horizontal']}, vertically in {told['exceeded_vertical']}, without an alert in "
        f"{told['exceeded_unalerted']}; {told['bad_starts']} fixes of bad starts; {told['blunders_s']:.1f} s with an "
        "error above 1 m and 4σ"
    )


HONESTY = ("NEES/dof", "beyond 99.99 %, max m", "levels", "exceeded h / v", "bad starts", "s > 1 m, 4σ")


def tables(recordings, calibrated):
    """Show every recording and the summaries; all of it as one object."""
    plain = {recording.name: plain_of(recording) for recording in recordings}
    rounds = [("default", recordings, {})]
    if calibrated:
        found, trained_on = calibrations_of(recordings)
        others = [one for one in recordings if one.trained_by in found and one.name not in trained_on]
        rounds.append(("calibrated", others, found))
    told = {}
    for kind, these, calibrations in rounds:
        print(f"\n{kind}:\n")
        heading("recording", "fixes", "replay 2-D / 3-D m", "plain m", "ratio", *HONESTY)
        rows = []
        for recording in these:
            scored = judged(recording, calibrations.get(recording.trained_by))
            plain_2d_m, plain_3d_m, count = plain[recording.name]
            available = scored.fixes / count if count else 0.0
            rows.append(Row(recording.name, recording.group, available, scored, plain_2d_m, plain_3d_m))
            show_row(rows[-1])
        told[kind] = {"recordings": [as_told(row) for row in rows]}
        print()
        for group in [*sorted({row.group for row in rows}), "all"]:
            told[kind][group] = summary([row for row in rows if group in (row.group, "all")])
            show_summary(f"{kind}, {group}", told[kind][group])
    return told


def as_told(row):
    return {**msgspec.to_builtins(row), "ratio_2d": row.ratio_2d, "ratio_3d": row.ratio_3d}


def packet_table(packets, measurements):
    """Show recordings of packets; all of it as a list."""
    print()
    heading("packets", "measurements", "fixes", "median m", "RMSE 2-D m", "claimed σ m", "HPL m", *HONESTY)
    told = []
    for one in packets:
        row = packets_judged(one, measurements)
        told.append(row)
        median_m = "–" if row["median_m"] is None else "{:.2f}, {:.2f}".format(*row["median_m"])
        fixes = str(row["fixes"]) if row["reason"] is None else f"none: {row['reason']}"
        metres = (number(row[name], ".3f") for name in ("rmse_2d_m", "claimed_m", "hpl_m"))
        scored = msgspec.convert({name: row[name] for name in Score.__struct_fields__}, Score)
        line(row["name"], str(row["measurements"]), fixes, median_m, *metres, *honesty(scored))
    return told


def main(arguments=None):
    default = Path(os.environ.get("SKYLESS_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=default)
    parser.add_argument("--calibrated", action="store_true", help="also calibrate on trial 1 and replay the others")
    parser.add_argument("--only", default="", help="recordings whose name holds this text")
    parser.add_argument("--measurements", help="of recordings of packets, instead of what suits each")
    parser.add_argument("--json", action="store_true", help="end with all of it as one line")
    asked = parser.parse_args(arguments)
    recordings = [one for one in recordings_in(asked.folder) if asked.only in one.name]
    packets = [one for one in packets_in(asked.folder) if asked.only in one.name]
    if not recordings and not packets:
        parser.error(f"no recordings in {asked.folder}: give their folder, or set SKYLESS_DATA to it")
    told = tables(recordings, asked.calibrated) if recordings else {}
    if packets:
        told["packets"] = packet_table(packets, asked.measurements)
    if asked.json:
        print(json.dumps(told))


if __name__ == "__main__":
    main()
