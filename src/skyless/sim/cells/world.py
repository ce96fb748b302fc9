"""``CellWorld``: what tags receive among up to 10,000 anchors and more, computed on demand.

Anchors are arrays here, not machines: their clocks, schedules and receptions are functions of keys, so that a tag costs
only the frames that it can receive, and for each of these the sender's newest receptions of other anchors. What a tag
receives does not depend on other tags, on the spans in which it is asked for, or on the process that computes it.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.air.almanac import period_ticks
from skyless.core.air.frame import after_rmarker_s
from skyless.core.arrays import Array, Integers
from skyless.core.site import Site
from skyless.core.ticks import TICK_MASK, TICK_S, from_seconds
from skyless.sim.cells.reception import (
    KNOT_TICKS,
    PREAMBLE_TICKS,
    RANGE_CHANGING,
    RANGE_CONSTANT,
    SURVEY,
    TAG_NODES,
    CellClocks,
    anchors_within,
    key_of,
    list_neighbours,
    make_grid,
    normal,
    purpose_key,
    rules_of,
)
from skyless.sim.cells.receptions import (
    KNOTS_A_LENGTH,
    LOOK_BACK_TICKS,
    PairErrors,
    Path,
    Scene,
    Senders,
    Table,
    TagPath,
    fill_relays,
    make_buckets,
    receive_at_tag,
    scheduled_table,
)
from skyless.sim.impairments import Impairments, RangeErrorModel
from skyless.sim.trajectory import Trajectory
from skyless.site.kernels import kernel

MAX_RELAYS: Final = 6
"""In a frame: more than six hardly make fixes better."""

FRAME_BYTES: Final = 123
"""Length of every frame: a beacon of protocol 2 with six relays and a page."""

_NOT_MODELLED: Final = (
    "anchor_biases", "delay_errors", "anchor_outages", "anchor_displacements", "anchor_pair_errors", "body", "warm_ups",
    "diagnostics",
)  # fmt: skip

_CELL_M: Final = 100.0
"""Width of the cells in which interferers are looked for; the reach of a frame is 193 m."""


class CellAnchors(Struct, frozen=True):
    """Anchors as arrays, so that 10,000 need no site file."""

    ids: Integers
    """Identifiers, shape (n,)."""
    positions_m: Array
    """As configured, shape (n, 3)."""
    tx_delays_ticks: Integers
    """Configured antenna delays, shape (n,)."""


def anchors_of(site: Site) -> CellAnchors:
    """The anchors of a site, in the order of its file."""
    return CellAnchors(
        np.array([anchor.id for anchor in site.anchors]),
        np.array([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors]),
        np.array([anchor.tx_antenna_delay_ticks for anchor in site.anchors]),
    )


@dataclass(slots=True, eq=False)
class TagReceptions:
    """What a tag received in a span, one frame a row, in the order of emission."""

    tag: int
    from_s: float
    to_s: float
    """The frames were emitted in [from_s, to_s)."""
    anchor: Integers
    """Identifiers of the senders, shape (n,)."""
    sequence: Integers
    tx_ticks: Integers
    """TX stamps, 40 bits."""
    rx_ticks: Integers
    """The tag's RX stamps, 40 bits."""
    emission_ticks: Integers
    """True time at which the RMARKER left, whole ticks; and its fraction."""
    emission_fraction: Array
    positions_m: Array
    """True positions of the tag at the emission, shape (n, 3)."""
    relays: Integers
    """Number of relays of each frame, shape (n,)."""
    relay_anchor: Integers
    """Their anchors, the most recent first, shape (n, most relays); -1 where there are fewer."""
    relay_sequence: Integers
    relay_rx_ticks: Integers

    def __len__(self) -> int:
        return len(self.anchor)

    @property
    def emission_s(self) -> Array:
        """True times of the emissions in seconds since the start."""
        return np.asarray((self.emission_ticks + self.emission_fraction) * TICK_S)


class CellWorld:
    """Many anchors, and tags that listen; deterministic by its seed."""

    def __init__(
        self,
        anchors: CellAnchors,
        period_codes: Integers,
        tags: Sequence[Trajectory],
        impairments: Impairments,
        seed: int,
        *,
        dead: Sequence[bool] | None = None,
        survey_std_m: float = 0.0,
        frame_bytes: int = FRAME_BYTES,
        lead_s: float = 1e-3,
    ) -> None:
        """``period_codes``: codes of the anchors' mean periods (``skyless.core.air.almanac``), shape (n,).

        ``dead``: which anchors neither send nor receive. ``survey_std_m``: true less configured positions, per axis.

        ``lead_s``: how long before its RMARKER a frame's relays are fixed, as in ``World``. Of the impairments those of
        stamps, oscillators, channel and range errors are modelled. Raises ValueError, which names the key, for others.
        """
        plain = Impairments()
        for name in _NOT_MODELLED:
            if getattr(impairments, name) != getattr(plain, name):
                raise ValueError(f"impairments.{name} is {getattr(impairments, name)!r}: several cells do not model it")
        count = len(anchors.ids)
        self.anchors, self.tags = anchors, tuple(tags)
        self._longest_period_ticks = max(map(period_ticks, period_codes.tolist()))
        self._lead_ticks, self._after_ticks = from_seconds(lead_s), from_seconds(after_rmarker_s(frame_bytes))
        keys = np.concatenate((anchors.ids, TAG_NODES + np.arange(len(self.tags)))).astype(np.int64)
        self._rules = rules_of(impairments.channel, impairments.tx_stamp_ps, impairments.rx_stamp_ps, seed)
        self._clocks = CellClocks(impairments.oscillator, keys, seed)
        errors_m = np.empty((count, 3))
        survey_errors(seed, anchors.ids, survey_std_m, errors_m)
        self.true_positions_m: Array = anchors.positions_m + errors_m
        """Shape (anchors, 3)."""
        self._near_grid = make_grid(self.true_positions_m, self._rules.audible_m / 2.0)
        self._senders = Senders(
            keys[:count],
            anchors.ids,
            np.asarray(period_codes, dtype=np.int64),
            anchors.tx_delays_ticks,
            self._clocks.cover(0, 0).ticks[:count, 0].copy(),
            np.asarray(np.zeros(count) if dead is None else dead, dtype=np.int64),
        )
        self._keys = keys
        self._cells = make_grid(self.true_positions_m, _CELL_M)
        self._neighbours = list_neighbours(self._rules, self._near_grid, self.true_positions_m, keys[:count])
        self._most_neighbours = int(np.diff(self._neighbours.offsets).max())
        model = impairments.range_errors
        self._errors = _pair_errors(model, seed)
        self._paths = [TagPath(tag, length=model.correlation_m is not None) for tag in self.tags]
        self._span = (0, 0)
        self._scene: Scene | None = None

    def run(
        self, until_s: float, *, from_s: float = 0.0, span_s: float = 0.5, tags: Sequence[int] | None = None
    ) -> Iterator[TagReceptions]:
        """What tags (by default all) receive, span by span and in each tag by tag; memory grows with ``span_s`` alone.

        For several workers each makes the same world and runs some of the tags.
        """
        listening = range(len(self.tags)) if tags is None else tags
        for number in range(math.ceil((until_s - from_s) / span_s)):
            begin_s = from_s + number * span_s
            end_s = min(from_s + (number + 1) * span_s, until_s)
            for tag in listening:
                yield self.receptions(tag, begin_s, end_s)

    def receptions(self, tag: int, from_s: float, to_s: float) -> TagReceptions:
        """What a tag receives of the frames emitted in [from_s, to_s).

        Cheapest in the order of time, all tags of a span one after the other.
        """
        from_ticks, to_ticks = from_seconds(from_s), from_seconds(to_s)
        scene = self._prepared(from_ticks, to_ticks)
        path = self._paths[tag].cover(from_ticks, to_ticks)
        near = self._near(path, from_ticks, to_ticks)
        found = self._receive(scene, tag, near, path, from_ticks, to_ticks)
        return self._with_relays(scene, tag, (from_s, to_s), *found)

    # Scenes

    def _prepared(self, from_ticks: int, to_ticks: int) -> Scene:
        """Frames and clocks for the receptions of a span, and for the relays that they carry."""
        if self._scene is None or from_ticks < self._span[0] or to_ticks > self._span[1]:
            margin = self._after_ticks + PREAMBLE_TICKS + from_seconds(1e-4)
            begin = max(from_ticks - LOOK_BACK_TICKS - self._lead_ticks - 2 * margin, 0)
            end = to_ticks + margin
            more = 2 * self._longest_period_ticks + KNOT_TICKS
            knots = self._clocks.cover(begin - more, end + more)
            table = scheduled_table(
                self._rules,
                knots,
                self._senders,
                lead_ticks=self._lead_ticks,
                after_ticks=self._after_ticks,
                from_ticks=begin,
                to_ticks=end,
            )
            self._scene = self._scene_of(table, begin, end)
            self._span = (from_ticks, to_ticks)
        return self._scene

    def _scene_of(self, table: Table, from_ticks: int, to_ticks: int) -> Scene:
        knots = self._clocks.cover(from_ticks, to_ticks)
        buckets = make_buckets(table, self._cells, from_ticks, to_ticks)
        return Scene(
            self._rules, knots, table, buckets, self._cells, self._neighbours, self.true_positions_m, self._keys
        )

    # Tags

    def _near(self, path: Path, from_ticks: int, to_ticks: int) -> Integers:
        """The anchors that a tag may receive anywhere on its way through a span."""
        middle_m, radius_m = _circle(path, from_ticks * TICK_S, to_ticks * TICK_S)
        found = np.empty(len(self.anchors.ids), dtype=np.int64)
        radius_m += self._rules.audible_m + 1e-3
        count = anchors_within(self._near_grid, self.true_positions_m, middle_m, radius_m, found)
        return np.sort(found[:count])

    def _receive(
        self, scene: Scene, tag: int, near: Integers, path: Path, from_ticks: int, to_ticks: int
    ) -> tuple[Integers, Integers, Integers, Array]:
        """Senders, columns of the table, RX stamps, and true positions, in the order of emission."""
        most = int(scene.table.used[near].sum())
        senders, columns, rx_ticks = (np.empty(most, dtype=np.int64) for _ in range(3))
        points_m = np.empty((most, 3))
        node = len(self.anchors.ids) + tag
        count = receive_at_tag(
            scene, node, near, path, self._errors, from_ticks, to_ticks, senders, columns, rx_ticks, points_m
        )
        senders, columns = senders[:count], columns[:count]
        order = np.argsort(scene.table.ticks[senders, columns], kind="stable")
        return senders[order], columns[order], rx_ticks[:count][order], points_m[:count][order]

    def _with_relays(
        self,
        scene: Scene,
        tag: int,
        span_s: tuple[float, float],
        senders: Integers,
        columns: Integers,
        rx_ticks: Integers,
        points_m: Array,
    ) -> TagReceptions:
        table, ids = scene.table, self.anchors.ids
        counts = np.zeros(len(senders), dtype=np.int64)
        anchors, sequences, relay_rx = (np.full((len(senders), MAX_RELAYS), -1, dtype=np.int64) for _ in range(3))
        tx_ticks = table.tx_ticks[senders, columns]
        most = max(self._most_neighbours, 1) * table.ticks.shape[1]
        fill_relays(scene, senders, tx_ticks, self._lead_ticks, most, counts, anchors, sequences, relay_rx)
        return TagReceptions(
            tag,
            *span_s,
            ids[senders],
            (table.first_number[senders] + columns) & 0xFF,
            tx_ticks & TICK_MASK,
            rx_ticks,
            table.ticks[senders, columns],
            table.fraction[senders, columns],
            points_m,
            counts,
            np.where(anchors >= 0, ids[anchors], -1),
            sequences,
            relay_rx,
        )


@kernel
def survey_errors(seed: int, ids: Integers, std_m: float, errors_m: Array) -> None:
    """Fill in the errors of anchors' positions, shape (n, 3)."""
    base = purpose_key(seed, SURVEY)
    for anchor in range(ids.shape[0]):
        for axis in range(3):
            errors_m[anchor, axis] = std_m * normal(key_of(base, ids[anchor], axis, 0))


def _pair_errors(model: RangeErrorModel, seed: int) -> PairErrors:
    return PairErrors(
        model.constant_m,
        model.slope_m,
        model.changing_m,
        (model.correlation_s or model.correlation_m or 1.0) / KNOTS_A_LENGTH,
        np.uint64(purpose_key(seed, RANGE_CONSTANT)),
        np.uint64(purpose_key(seed, RANGE_CHANGING)),
    )


def _circle(path: Path, from_s: float, to_s: float) -> tuple[tuple[float, float, float], float]:
    """Middle and radius of a sphere that holds the path from one time to another."""
    corners = []
    begin_s = from_s
    reach_m = 0.0
    for piece in path.pieces:
        end_s = min(float(piece["end_s"]), to_s)
        for t_s in (begin_s, end_s):
            dt_s = t_s - piece["origin_s"]
            corners.append(
                piece["position_m"] + dt_s * (piece["velocity_mps"] + 0.5 * dt_s * piece["acceleration_mps2"])
            )
        bulge_m = 0.125 * float(np.linalg.norm(piece["acceleration_mps2"])) * (end_s - begin_s) ** 2
        reach_m = max(reach_m, bulge_m)
        begin_s = end_s
        if end_s >= to_s:
            break
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    middle = 0.5 * (low + high)
    radius_m = 0.5 * float(np.linalg.norm(high - low)) + reach_m
    return (float(middle[0]), float(middle[1]), float(middle[2])), radius_m
