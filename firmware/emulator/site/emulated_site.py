"""A whole site in virtual time: the medium, a chip and a board at each node, and the real programs of their hosts.

    site = EmulatedSite(plan, [trajectory], make_board, seed=1)
    site.run(5.0)

Each board has a pseudo-terminal, which ``skyless.radio`` opens as ``serial:PATH``. What happens depends on the seed
alone, however busy the machine is.
"""

import asyncio
import contextlib
import random
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from emulator.seat import MakeBoard, Seat
from emulator.site.serial_wire import SerialWire, WireSettings
from emulator.site.site_air import SITE_TURNAROUND_S, SiteAir
from emulator.site.virtual_time import run_on
from emulator.site.watched_radio import WatchedRadio
from skyless.core.air.frame import Diagnostics
from skyless.core.protocol1.beacon import Beacon, decode_cached
from skyless.core.site import Site
from skyless.core.ticks import difference, wrap
from skyless.radio.interface import AntennaDelays
from skyless.run.anchor import Anchors
from skyless.run.mqtt.messages import FixMessage
from skyless.run.open_radio import open_radios
from skyless.run.tag import Tags, TagSettings
from skyless.sim.dw1000.chip import Chip
from skyless.sim.dw1000.transceiver import Fault
from skyless.sim.evaluation.scenarios import Request, Room, impairments_of
from skyless.sim.listening import TagSpec
from skyless.sim.medium import Delivery, Medium
from skyless.sim.trajectory import Trajectory
from skyless.sim.world import diagnostics_of

TAG_SETTINGS: Final = TagSettings(publish_hz=1000.0)
"""All fixes are kept."""
DIRECT_WIRE: Final = WireSettings()


class SiteChip(Chip):
    """A chip with faults of its surroundings."""

    absent = False
    """It answers with ones."""
    stuck: bool | None = None
    """State of an interrupt line that does not follow; None where it does."""

    @property
    def irq(self) -> bool:
        """The interrupt line as the board sees it."""
        real = super().irq
        return real if self.stuck is None else self.stuck

    def transfer(self, out: bytes, hz: int) -> bytes:
        """One transaction."""
        return b"\xff" * len(out) if self.absent else super().transfer(out, hz)


class SentFrame(Struct, frozen=True):
    """A frame that has left an antenna as a whole."""

    node: int
    frame: bytes
    tx_ticks: int
    """The sender's counter at the RMARKER."""
    time_s: float
    """True time of its end."""


class SiteNode:
    """An anchor or a tag: antenna, chip, board, wire and radio."""

    def __init__(
        self,
        medium: Medium[Any],
        number: int,
        name: str,
        delays: AntennaDelays,
        wire: SerialWire,
        make_board: MakeBoard,
        *,
        can_transmit: bool,
    ) -> None:
        self.name = name
        self.delays = delays
        self.air = SiteAir(medium, number)
        self.chip = SiteChip(self.air, delays.tx_ticks, delays.rx_ticks, self.air.now_s)
        self.chip.on_wake = partial(medium.switch_on, number)
        self.at_antenna: dict[tuple[bytes, int], float] = {}
        """Frames that the antenna got while it was not sending, by their bytes and stamps: when each ended, in s."""
        self.wire = wire
        self.board = make_board(Seat(medium.timeline, self.chip, wire.send, can_transmit, number.to_bytes(8, "little")))
        self.radios: list[WatchedRadio] = []
        """Of its programs one after the other."""
        self.task: asyncio.Task[None] | None = None

    @property
    def radio(self) -> WatchedRadio:
        """Of its present program, or its last one."""
        return self.radios[-1]

    @property
    def heard(self) -> set[tuple[bytes, int]]:
        """Frames and stamps that reached its programs."""
        return set[tuple[bytes, int]]().union(*(radio.heard for radio in self.radios))

    @property
    def made(self) -> set[tuple[bytes, int]]:
        """Frames of its programs and their times."""
        return set[tuple[bytes, int]]().union(*(radio.made for radio in self.radios))

    @property
    def is_sending(self) -> bool:
        """Whether the RMARKER of its frame has left, and its end has not."""
        sending = self.chip.transceiver.sending
        return sending is not None and difference(self.air.now_ticks(), sending.marker_ticks) > 0


class SiteResult(Struct, frozen=True):
    """One run."""

    slots: int
    """Slots after the warm-up."""
    sent: int
    """Frames in them."""
    late: int
    """Frames that came too late for their boards, in the same time; none of them was sent."""
    at_antennas: int
    """Receptions at all antennas."""
    reported: int
    """Those that reached the programs."""
    least_reported: float
    """Share of those of the worst node."""
    wrong: int
    """Receptions at programs that no antenna got with that stamp, and frames on the air that no anchor made so."""
    misused: dict[str, int]
    """Uses of chips, and of an emulated processor, that their manuals forbid."""
    fixes: int
    rms_m: float
    """Error of the tags' positions (2-D), root mean square over all fixes."""


class EmulatedSite:
    """One site, deterministic by its seed. ``make_board`` makes every node's board."""

    def __init__(
        self,
        site: Site,
        trajectories: Sequence[Trajectory],
        make_board: MakeBoard,
        *,
        seed: int = 1,
        wire: WireSettings = DIRECT_WIRE,
        lead_s: float | None = None,
        room: Room | None = None,
    ) -> None:
        """``lead_s``: how early anchors hand their frames over at first; None for what their radios ask for.

        ``room``: errors of survey and ranges; None for none.
        """
        self.site, self._seed, self._make_board, self._wire, self._lead_s = site, seed, make_board, wire, lead_s
        self.trajectories = list(trajectories)
        faults = replace(impairments_of(Request(site, seed=seed, room=room, carrier=True), site), diagnostics=True)
        tags = [TagSpec(trajectory) for trajectory in trajectories]
        self.medium: Medium[bool] = Medium(site, tags, faults, seed, self._deliver, SITE_TURNAROUND_S)
        self.anchors = [
            self._node(
                number, str(anchor.id), AntennaDelays(anchor.tx_antenna_delay_ticks, anchor.rx_antenna_delay_ticks)
            )
            for number, anchor in enumerate(site.anchors)
        ]
        count = len(self.anchors)
        self.tags = [self._node(count + index, f"tag{index + 1}", AntennaDelays()) for index in range(len(tags))]
        self.nodes = self.anchors + self.tags
        self.sent: list[SentFrame] = []
        self.cut = 0
        """Frames whose sender's supply failed before they ended."""
        self.fixes: dict[str, list[tuple[FixMessage, float]]] = {node.name: [] for node in self.tags}
        """Fixes of each tag, with when its antenna had got the frame, in s of true time."""
        self.log: list[str] = []

    def _node(self, number: int, name: str, delays: AntennaDelays) -> SiteNode:
        self.medium.switch_on(number)
        wire = SerialWire(self.medium.timeline, self._wire, random.Random(f"{self._seed} wire {number}"))
        is_anchor = number < len(self.site.anchors)
        return SiteNode(self.medium, number, name, delays, wire, self._make_board, can_transmit=is_anchor)

    # Time

    def run(self, seconds: float) -> None:
        """Let everything start, run for some seconds, and end."""
        run_on(self.medium.timeline, self._play(seconds))

    async def _play(self, seconds: float) -> None:
        async with self:
            await asyncio.sleep(seconds)

    async def __aenter__(self) -> "EmulatedSite":
        """Connect all boards, and start all programs."""
        for node in self.nodes:
            node.wire.start(node.board.receive)
            self.start_host(node)
        return self

    async def __aexit__(self, *_: object) -> None:
        """End all."""
        for node in self.nodes:
            await self.stop_host(node)
            close = getattr(node.board, "close", None)
            if close is not None:
                close()
            node.wire.close()

    # Boards

    def brown_out(self, node: SiteNode, part: Literal["processor", "chip", "both"]) -> None:
        """Let the supply fail for a moment, for the processor, its radio, or both."""
        if part != "processor":
            self.medium.switch_off(node.air.node)
            self.medium.switch_on(node.air.node)
            node.chip.power_cycle()
        if part != "chip":
            node.board.power_cycle()
        else:
            node.board.notify()

    # Programs

    def start_host(self, node: SiteNode) -> None:
        """Start the program of a node."""
        kind: Literal["anchor", "tag"] = "anchor" if node in self.anchors else "tag"
        (real,) = open_radios(f"serial:{node.wire.path}@1000000", kind, (node.name,), [node.delays])
        radio = WatchedRadio(real, self._lead_s)
        node.radios.append(radio)
        if node in self.anchors:
            work = Anchors(self.site, [radio], None, self.log.append, simulated=lambda: True).run()
        else:
            work = Tags(TAG_SETTINGS, [radio], None, self.log.append, lambda fix: self._on_fix(node, fix)).run()
        node.task = asyncio.ensure_future(work)

    async def stop_host(self, node: SiteNode) -> None:
        """Let the program of a node vanish."""
        if node.task is not None:
            task, node.task = node.task, None
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    def _on_fix(self, node: SiteNode, fix: FixMessage) -> None:
        self.fixes[node.name].append((fix, node.at_antenna[next(reversed(node.radio.heard))]))

    # The air

    def _deliver(self, delivery: Delivery) -> None:
        """A frame has ended: at its sender, and at all that can receive it."""
        flight, medium = delivery.flight, self.medium
        sender, now_s = self.nodes[flight.sender], medium.now_s
        is_whole = flight.boot == medium.boots[flight.sender]
        if is_whole:
            tx_ticks = wrap(flight.marker_local_ticks)
            self.sent.append(SentFrame(flight.sender, flight.frame, tx_ticks, now_s))
            sender.chip.transceiver.finish()
            sender.board.notify()
        else:
            self.cut += 1
        for rows in (delivery.by_anchors, delivery.by_tags):
            for row in rows:
                node = self.nodes[int(row["node"])]
                rx_ticks = int(row["rx_ticks"])
                if is_whole:
                    node.at_antenna[flight.frame, rx_ticks] = now_s
                measured = diagnostics_of(row) or Diagnostics()
                fault: Fault | None = None if is_whole else "parity"
                phase_cycles = float(row["phase_cycles"])
                node.chip.receive(flight.frame, rx_ticks, measured, fault, carrier_phase_cycles=phase_cycles)
                node.board.notify()

    # What came of it

    def result(self, warmup_s: float) -> SiteResult:
        """What was sent, reported and computed since ``warmup_s``, by what the antennas got and sent."""
        count, end_s = len(self.anchors), self.medium.now_s - 5e-3  # what is on its way at the end is not judged
        slots = set()
        wrong = 0
        made = [node.made for node in self.nodes]
        for one in self.sent:
            beacon = decode_cached(one.frame)
            wrong += (one.frame, one.tx_ticks) not in made[one.node]
            if isinstance(beacon, Beacon) and warmup_s <= one.time_s < end_s:
                slots.add(beacon.superframe * count + one.node)
        first, last = (min(slots), max(slots) + 1) if slots else (0, 0)
        misused: Counter[str] = Counter()
        at_antennas, reported, least = 0, 0, 1.0
        for node in self.nodes:
            heard = node.heard
            judged = {key for key, ended_s in node.at_antenna.items() if warmup_s <= ended_s < end_s}
            wrong += len(heard - node.at_antenna.keys())
            at_antennas += len(judged)
            reported += len(judged & heard)
            least = min(least, len(judged & heard) / max(len(judged), 1))
            misused += node.chip.misuse + node.air.counts + getattr(node.board, "misuse", Counter())
        errors_m2 = [
            float(np.sum((np.array(fix.position_m) - self.trajectories[index].position(ended_s))[:2] ** 2))
            for index, node in enumerate(self.tags)
            for fix, ended_s in self.fixes[node.name]
            if warmup_s <= ended_s
        ]
        late = sum(time_s >= warmup_s for node in self.anchors for radio in node.radios for time_s in radio.late)
        return SiteResult(
            slots=last - first,
            sent=len(slots),
            late=late,
            at_antennas=at_antennas,
            reported=reported,
            least_reported=least,
            wrong=wrong,
            misused=dict(misused),
            fixes=len(errors_m2),
            rms_m=float(np.sqrt(np.mean(errors_m2))) if errors_m2 else float("nan"),
        )
