"""What a tag's ``Receiver`` keeps, as values: to be encoded, and to continue from."""

from msgspec import Struct

from skyless.air.master_term import FollowedMaster
from skyless.air.site_choice import SiteChoice
from skyless.positioning.fix import NoFixReason
from skyless.positioning.methods.factory import MethodOptions
from skyless.positioning.methods.joint import EstimationState
from skyless.positioning.methods.observations import FixTime, StampTracks
from skyless.positioning.methods.selection import AnchorSelectionState
from skyless.positioning.methods.snapshots import SnapshotsState
from skyless.positioning.observation import Observation
from skyless.site.almanac_pages import AlmanacState
from skyless.site.local_almanac import LocalAlmanacState
from skyless.ticks import Unwrapper


class ReceiverState(Struct, frozen=True):
    """All that a ``Receiver`` keeps; to be used or encoded before its next frame, as they share some parts."""

    options: MethodOptions
    choice: SiteChoice
    counters: dict[str, int]
    reason: NoFixReason
    almanac: AlmanacState
    time: FixTime
    own_ticks: Unwrapper
    stamps: StampTracks
    followed: FollowedMaster
    master: int | None
    master_scale: tuple[int, int] | None
    superframe_ticks: int
    has_method_key: bool
    """Whether a method has been looked for since stamps were forgotten."""
    method: EstimationState | SnapshotsState | None
    local_almanac: LocalAlmanacState
    selection: AnchorSelectionState
    waiting: tuple[Observation, ...]
    moved_ticks: dict[int, int]
    uses_moved: bool = False
