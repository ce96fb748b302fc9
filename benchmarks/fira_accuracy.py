"""The emulated FiRa tag's errors beside what ``skyless plan`` predicts for the site.

    python benchmarks/fira_accuracy.py [--worlds N] [--seeds N] [--json]

Tags rest at six points of the lab, whose survey and ranges have the errors that its site file assumes, other ones in
each world (those of ``skyless plan --verify``). Beacons become notifications of UCI, and these packets and fixes, as in
``skyless board --wire uci`` and ``skyless tag --radio uci:PATH``. Fixes are judged from two seconds on.

``both ways``: two frames of each anchor in a superframe, so that rounds end with a final message and initiator and
responders relay each other. ``one way``: one frame, so that only responders relay the poll. Columns: RMSE over all
worlds and points; that of ``skyless plan`` for the same site, method joint; their ratio.
"""

import argparse
import json
import math
from collections import Counter
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from skyless.air.uci import UciReader
from skyless.evaluation.fleet import world_of
from skyless.evaluation.scenarios import Request, Room, impairments_of
from skyless.nodes.uci_board import UciProtocol
from skyless.planning.columns import RMSE
from skyless.planning.predict import PlanSettings, Predictor
from skyless.positioning.masterless.packet_tracking import DL_TDOA, DL_TDOA_ONE_WAY, PacketTracking
from skyless.recordings.foreign.fira import DtTag
from skyless.simulation.range_errors import RangeErrorModel
from skyless.simulation.trajectory import Static
from skyless.site.lab import lab_site

POINTS_M = np.array([(2.0, 3.0), (1.0, 1.0), (4.5, 6.0), (3.0, 4.0), (5.0, 2.0), (0.7, 7.0)])
WARM_UP_S, UNTIL_S = 2.0, 4.0
QA = 0.3
"""The default of ``skyless tag`` and ``skyless plan``."""

ROUNDS = {"both ways": 2, "one way": 1}
"""Frames of a node in a superframe."""


class Measured(NamedTuple):
    """Errors of all tags in all worlds."""

    rmse_m: float
    planned_m: float
    ratio: float
    fixes: int


def site_with(frames):
    """The lab, with that many frames of each node in a superframe."""
    site = lab_site()
    return replace(site, schedule=replace(site.schedule, frames_per_node=frames))


def world(site, seed, number):
    """One world with its own errors of survey and ranges; the slope has both signs in turn."""
    errors = site.accuracy
    ranges = RangeErrorModel(
        constant_m=math.sqrt(3.0) * errors.range_std_m,
        slope_m=errors.slope_std_m * (-1.0) ** number,
        changing_m=errors.place_std_m,
        correlation_s=errors.place_time_s,
    )
    request = Request(site=site, seed=seed + number, room=Room(axis_std_m=errors.survey_std_m, ranges=ranges))
    return world_of(site, [Static(*point) for point in POINTS_M.tolist()], impairments_of(request, site), request.seed)


class Tag:
    """A board and the tag that is connected to it."""

    def __init__(self, version):
        drops, self._stream, known = Counter(), bytearray(), {"height_m": 0.0, "qa": QA}
        self._board = UciProtocol(self._hear, version)
        self._reader, self._tag = UciReader(drops), DtTag(drops)
        one_way = replace(DL_TDOA_ONE_WAY, **known)
        self._tracking = PacketTracking(replace(DL_TDOA, **known), {}, 40, one_way=one_way)

    def _hear(self, data):
        self._stream += data
        return True

    def fixes(self, reception):
        """Fixes that a reception of the board completes."""
        self._board.on_radio_event(reception)
        packets = self._reader.feed(bytes(self._stream))
        self._stream.clear()
        found = [self._tracking.on_packet(one) for packet in packets for one in self._tag.on_uci(packet)]
        return [fix for fix in found if fix is not None]


def measure(frames, worlds, seed, version=1):
    """Errors with that many frames of a node in a superframe."""
    site, squares, fixes = site_with(frames), 0.0, 0
    for number in range(worlds):
        tags = [Tag(version) for _ in POINTS_M]
        for broadcast in world(site, seed, number).run(UNTIL_S):
            for tag, reception, truth_m in broadcast.receptions():
                for fix in tags[tag].fixes(reception):
                    if broadcast.end_s > WARM_UP_S:
                        squares += float(np.sum((fix.position_m - truth_m)[:2] ** 2))
                        fixes += 1
    planned = Predictor(site, PlanSettings(qa=QA)).at(np.column_stack([POINTS_M, np.zeros(len(POINTS_M))]))[:, RMSE]
    rmse_m, planned_m = math.sqrt(squares / fixes), math.sqrt(float(np.mean(planned**2)))
    return Measured(rmse_m, planned_m, rmse_m / planned_m, fixes)


def main():
    """Print the table."""
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    asked.add_argument("--worlds", type=int, default=20)
    asked.add_argument("--seeds", type=int, default=3)
    asked.add_argument("--json", action="store_true")
    arguments = asked.parse_args()
    for name, frames in ROUNDS.items():
        for number in range(arguments.seeds):
            found = measure(frames, arguments.worlds, 1 + 1000 * number)
            if arguments.json:
                print(json.dumps({"rounds": name, "seed": 1 + 1000 * number, **found._asdict()}))
            else:
                print(
                    f"{name:<10} seed {1 + 1000 * number:>4}: {100 * found.rmse_m:.2f} cm, "
                    f"plan {100 * found.planned_m:.2f} cm, ratio {found.ratio:.3f} ({found.fixes} fixes)"
                )


if __name__ == "__main__":
    main()
