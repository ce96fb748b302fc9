"""What a tag's ``Receiver`` keeps, as values: to be encoded, and to continue from."""

from msgspec import Struct

from skyless.core.air.local_almanac import LocalAlmanacState
from skyless.core.observation import Observation
from skyless.core.tag.beacon_receiver import AdmissionState
from skyless.core.tag.joint import EstimationState
from skyless.core.tag.selection import AnchorSelection


class ReceiverState(Struct, frozen=True, tag="protocol-2"):
    """All that a ``Receiver`` keeps; to be used or encoded before its next frame, as they share some parts."""

    admission: AdmissionState
    almanac: LocalAlmanacState
    method_period_ticks: int
    method: EstimationState | None
    selection: AnchorSelection
    waiting: tuple[Observation, ...]
    moved_ticks: dict[int, int]
    uses_moved: bool
