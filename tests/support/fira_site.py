"""A FiRa tag on an emulated board, in worlds with their own errors, next to what ``skyless plan`` predicts.

Tags rest at six points of the lab, whose survey and ranges have the errors that its site file assumes, other ones in
each world. Beacons become notifications of UCI, and these packets and fixes, as in ``skyless board --wire uci`` and
``skyless tag --radio uci:PATH``. Fixes are judged from two seconds on.
"""

import math
from collections import Counter
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from skyless.core.site import AccuracySite
from skyless.core.ticks import TICK_BITS
from skyless.radio.foreign.fira import DtTag
from skyless.radio.foreign.uci import AnchorFrame
from skyless.run.board import UciProtocol
from skyless.run.masterless.packet_tracking import DL_TDOA, DL_TDOA_ONE_WAY, PacketTracking
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.evaluation.scenarios import Request, Room, impairments_of
from skyless.sim.impairments import RangeErrorModel
from skyless.sim.lab import paper_lab_site
from skyless.sim.trajectory import Static
from skyless.site.channel import ChannelModel
from skyless.site.planning.links import RMSE
from skyless.site.planning.maps import Predictor
from skyless.site.planning.superframe import Relays, Superframe

POINTS_M = np.array([(2.0, 3.0), (1.0, 1.0), (4.5, 6.0), (3.0, 4.0), (5.0, 2.0), (0.7, 7.0)])
PLACES_M = np.column_stack([POINTS_M, np.zeros(len(POINTS_M))])
WARM_UP_S, UNTIL_S = 2.0, 4.0
QA = 0.3
"""The default of ``skyless tag`` and ``skyless plan``."""

ROUNDS = {"both ways": 2, "one way": 1}
"""Frames of a node in a superframe."""

KNOWN = {"height_m": 0.0, "qa": QA}


class Measured(NamedTuple):
    """Errors of all tags in all worlds."""

    rmse_m: float
    planned_m: float
    round_planned_m: float
    ratio: float
    round_ratio: float
    fixes: int


def planned_m(site):
    """RMSE over the points by ``skyless plan``."""
    table = Predictor(site, ChannelModel()).at(PLACES_M)
    return math.sqrt(float(np.mean(table[:, RMSE] ** 2)))


def round_planned_m(site, settings):
    """The same where tags receive a round's messages only, which relay the poll, or the responses in the final one."""
    planner = Predictor(site, ChannelModel())
    superframe, relays, master = planner.superframe, planner.relays, planner.master
    messages = len(site.anchors) + site.schedule.frames_per_node - 1
    begins, ends, kept = [0, *relays.ends[:-1].tolist()], [], []
    for k in range(messages):
        is_final = k > 0 and superframe.sender[k] == master
        rows = range(begins[k], relays.ends[k]) if k > 0 else ()
        kept += [row for row in rows if is_final or relays.sender[row] == master]
        ends.append(len(kept))
    gaps_s = superframe.gap_s[:messages].copy()
    gaps_s[0] += superframe.gap_s[messages:].sum()
    superframe = Superframe(superframe.sent, superframe.sender[:messages], gaps_s)
    rest = (column[kept].copy() for column in relays[1:])
    planner.estimator, planner.superframe = settings, superframe
    planner.relays = Relays(np.array(ends, np.int64), *rest)
    table = planner.at(PLACES_M)
    return math.sqrt(float(np.mean(table[:, RMSE] ** 2)))


def site_with(frames):
    """The lab, with that many frames of each node in a superframe."""
    site = paper_lab_site(accuracy=AccuracySite())
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
        drops, self._stream = Counter(), bytearray()
        self._board = UciProtocol(self._hear, version)
        self._tag = DtTag(drops, AnchorFrame())
        one_way = DL_TDOA_ONE_WAY.changed(**KNOWN)
        self._tracking = PacketTracking(DL_TDOA.changed(**KNOWN), {}, TICK_BITS, one_way=one_way)

    def _hear(self, data):
        self._stream += data
        return True

    def fixes(self, reception):
        """Fixes that a reception of the board completes."""
        self._board.on_radio_event(reception)
        packets = list(self._tag.feed(bytes(self._stream)))
        self._stream.clear()
        found = [self._tracking.on_packet(packet) for packet in packets]
        return [fix for fix in found if fix is not None]


def measure(frames, worlds, seed, version=1, until_s=UNTIL_S):
    """Errors with that many frames of a node in a superframe."""
    site, squares, fixes = site_with(frames), 0.0, 0
    for number in range(worlds):
        tags = [Tag(version) for _ in POINTS_M]
        for broadcast in world(site, seed, number).run(until_s):
            for tag, reception, truth_m in broadcast.receptions():
                for fix in tags[tag].fixes(reception):
                    if broadcast.end_s > WARM_UP_S:
                        squares += float(np.sum((fix.position_m - truth_m)[:2] ** 2))
                        fixes += 1
    settings = (DL_TDOA if frames > 1 else DL_TDOA_ONE_WAY).changed(**KNOWN)
    rmse_m, plan_m, round_m = math.sqrt(squares / fixes), planned_m(site), round_planned_m(site, settings)
    return Measured(rmse_m, plan_m, round_m, rmse_m / plan_m, rmse_m / round_m, fixes)
