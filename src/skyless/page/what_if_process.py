"""Process that prepares a recording for recomputation by a page, which runs the estimator as WebAssembly."""

import ctypes
from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from msgspec import Struct

from skyless.core.air.frame import Diagnostics, Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.core.errors import SkylessError
from skyless.core.estimator.estimator import Estimator
from skyless.core.estimator.process import BatchPacket, BatchRow, Place, Relay, take_relays
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import State, covariances
from skyless.core.fix import Fix
from skyless.core.integrity import HPL
from skyless.core.native.library import SOURCE, source_digest
from skyless.core.native.records import Record, first
from skyless.core.native.views import view
from skyless.core.tag.admission import Tag
from skyless.core.tag.receiver import Receiver
from skyless.page.tasks import WhatIfTask, serve_tasks
from skyless.run.mqtt.messages import RawReception, SegmentStart
from skyless.run.recordings.reception_log import receiver_of
from skyless.run.recordings.recording import McapRecording

_PAGE_BYTES: Final = 1024
_LEAST_STD_M: Final = 0.1
"""Least standard deviation of a filter that begins at a fix, as its anchors may be moved."""


class WhatIfAnchor(Struct, frozen=True):
    """An anchor of the packets."""

    id: int
    position_m: tuple[float, float, float]


class WhatIf(Struct, frozen=True):
    """Tables in the memory layout of ``skyless_core.h``, for ``browser/estimator.js``."""

    digest: str
    """Digest of the source from which the WebAssembly must have been built."""
    begin_s: float
    """Time of the first fix, since ``begin_unix_s``."""
    times_s: list[float]
    """Times of the packets, since that fix."""
    recorded: list[tuple[float, float, float, float | None] | None]
    """The tag's result for each packet: position and horizontal protection level, or no fix."""
    anchors: list[WhatIfAnchor]
    layout: dict[str, int]
    """Sizes of records, and offsets of the fields that the page reads or changes."""
    state: list[tuple[int, bytes]]
    """The non-zero parts of the filter's first state: offset and content."""
    places: bytes
    packets: bytes
    relays: bytes


def what_if(task: WhatIfTask) -> WhatIf:
    """Prepare the tables of one recording. Raises SkylessError if there is nothing to recompute."""
    return _Tables(task).filled()


class _Tables:
    """Collects the packets of one tag from a fix on."""

    def __init__(self, task: WhatIfTask) -> None:
        self._task = task
        self._places: dict[int, Place] = {}
        self._packets: list[BatchPacket] = []
        self._relays: list[Relay] = []
        self._times_s: list[float] = []
        self._recorded: list[tuple[float, float, float, float | None] | None] = []
        self._state: State | None = None
        self._begin_s = 0.0

    def filled(self) -> WhatIf:
        """Read the recording, and return the tables. Raises SkylessError."""
        task, receiver = self._task, None
        with McapRecording(task.path) as recording:
            for start, raw, unix_s in _receptions(recording, task.tag):
                if start is not None:
                    if self._state is not None:
                        break  # after a gap the clock is another one
                    receiver = receiver_of(start.settings) or AnyReceiver()
                if receiver is not None and unix_s <= task.begin_unix_s + self._begin_s + task.seconds:
                    known = Diagnostics(raw.rx_power_dbm, raw.first_path_power_dbm, raw.carrier_offset_ppm)
                    heard = Reception(raw.frame, raw.rx_ticks, raw.host_s, known, raw.carrier_phase_cycles)
                    self._hear(receiver, heard, unix_s)
        if self._state is None:
            raise SkylessError(
                f"tag {task.tag} has no fix from there on that can be recomputed: it takes raw receptions at a site "
                "without a master"
            )
        anchors = [WhatIfAnchor(one.anchor, (*view(one.position_m).tolist(),)) for one in self._places.values()]
        content = bytes(self._state)
        pages = ((at, content[at : at + _PAGE_BYTES]) for at in range(0, len(content), _PAGE_BYTES))
        return WhatIf(
            digest=source_digest(SOURCE),
            begin_s=self._begin_s,
            times_s=self._times_s,
            recorded=self._recorded,
            anchors=anchors,
            layout=_layout(),
            state=[(at, page) for at, page in pages if any(page)],
            places=_bytes_of(list(self._places.values())),
            packets=_bytes_of(self._packets),
            relays=_bytes_of(self._relays),
        )

    def _hear(self, tag: AnyReceiver, reception: Reception, unix_s: float) -> None:
        heard = tag.counters["heard"]
        fix = tag.hear(reception)
        receiver = tag.receiver
        if not isinstance(receiver, Receiver) or tag.counters["heard"] == heard:
            return
        if self._state is not None:
            self._add(receiver.tag, fix, unix_s)
        elif fix is not None and receiver.method is not None and unix_s >= self._task.begin_unix_s:
            self._begin_s = unix_s - self._task.begin_unix_s
            self._state = _state_at(receiver.method.estimator, receiver.admission.rx_ticks)

    def _add(self, heard: Tag, fix: Fix | None, unix_s: float) -> None:
        packet = heard.packet
        if packet.place.anchor not in self._places:
            self._places[packet.place.anchor] = Place.from_buffer_copy(packet.place)
        if heard.relays.count == 0:  # the filter has not used the packet
            take_relays(packet, heard.relays, heard.beacon.relays, heard.beacon.relay_bytes)
        self._relays += [Relay.from_buffer_copy(one) for one in first(heard.relays.rows, heard.relays.count)]
        row = BatchPacket(
            place=list(self._places).index(packet.place.anchor),
            sequence=packet.sequence,
            rx_ticks=packet.rx_ticks,
            tx_ticks=packet.tx_ticks,
            variance_factor=packet.variance_factor,
            has_phase=packet.has_phase,
            phase_cycles=packet.phase_cycles,
            end=len(self._relays),
        )
        self._packets.append(row)
        self._times_s.append(unix_s - self._task.begin_unix_s - self._begin_s)
        self._recorded.append(None if fix is None else (*fix.position_m.tolist(), fix.hpl_m))


def _receptions(recording: McapRecording, tag: str) -> Iterator[tuple[SegmentStart | None, RawReception, float]]:
    """Receptions of a tag with their Unix times; the first of a segment comes with the segment's start."""
    for message in recording.receptions(tag):
        start = message.start
        for raw in message.receptions:
            if raw.host_s is not None:
                yield start, raw, raw.host_s + message.unix_less_host_s
                start = None


def _state_at(estimator: Estimator, rx_ticks: int) -> State:
    """State of a filter without anchors that begins at this one's position."""
    settings, dim = estimator.settings, estimator.dim
    fresh = Estimator(settings)
    covariance = covariances(estimator.state)[:dim, :dim] + _LEAST_STD_M**2 * np.eye(dim)
    fresh.start(rx_ticks, estimator.position_m(), covariance, settings.start_speed_std_mps**2)
    return fresh.state


def _layout() -> dict[str, int]:
    sizes = {made.__name__: ctypes.sizeof(made) for made in (State, Place, BatchPacket, Relay, BatchRow)}
    settings = _offset(State, "settings")
    return {
        **sizes,
        "State.tx_variance_m2": settings + _offset(EstimatorSettings, "tx_variance_m2"),
        "State.rx_variance_m2": settings + _offset(EstimatorSettings, "rx_variance_m2"),
        "Place.position_m": _offset(Place, "position_m"),
        "BatchPacket.place": _offset(BatchPacket, "place"),
        "BatchPacket.end": _offset(BatchPacket, "end"),
        "BatchRow.position_m": _offset(BatchRow, "position_m"),
        "BatchRow.hpl_m": _offset(BatchRow, "levels") + HPL * ctypes.sizeof(ctypes.c_double),
        "BatchRow.integrity": _offset(BatchRow, "integrity"),
        "BatchRow.outcome": _offset(BatchRow, "outcome"),
    }


def _offset(made: type[Record], field: str) -> int:
    found: Any = getattr(made, field)
    return int(found.offset)


def _bytes_of(rows: list[Any]) -> bytes:
    return b"".join(bytes(row) for row in rows)


if __name__ == "__main__":
    serve_tasks(WhatIfTask, what_if)
