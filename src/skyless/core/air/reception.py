"""What passes between a radio and the protocol machines."""

from msgspec import Struct


class Diagnostics(Struct, frozen=True, gc=False):
    """What a radio measured of one frame in addition to its time. A value is None where the radio does not report it.

    Powers are those of the chip's formulas without corrections (``core/air/first_path.py``).
    """

    rx_power_dbm: float | None = None
    first_path_power_dbm: float | None = None
    carrier_offset_ppm: float | None = None


class Reception(Struct, frozen=True, gc=False):
    """One frame as a radio received it.

    ``frame`` is the whole PSDU, FCS included. ``rx_ticks`` is the receiver's own 40-bit counter at the frame's
    RMARKER, antenna delay already subtracted. ``host_s`` is the host's clock, needed only to bridge gaps over 8.6 s.
    ``carrier_phase_cycles`` is the phase of the carrier at the first path, in [0, 1), where the radio measured it: it
    falls by one cycle while ``rx_ticks`` grows by the time of one (docs/phases.md).
    """

    frame: bytes
    rx_ticks: int
    host_s: float | None = None
    diagnostics: Diagnostics | None = None
    carrier_phase_cycles: float | None = None

    def __post_init__(self) -> None:
        """Refuse what is no frame or no count of ticks. Raises TypeError."""
        if type(self.frame) is bytes and type(self.rx_ticks) is int:
            return  # one is made for each frame: nothing else is looked at
        if not isinstance(self.frame, bytes):
            raise TypeError(f"frame is {self.frame!r:.80}; it should be bytes, the whole PSDU with its FCS")
        if not hasattr(self.rx_ticks, "__index__"):
            raise TypeError(f"rx_ticks is {self.rx_ticks!r}; it should be an integer, ticks of the receiver")


def phase_of(reception: Reception) -> float:
    """The phase of a reception's carrier in cycles, below 0 where it is not known: as compiled functions take it."""
    return -1.0 if reception.carrier_phase_cycles is None else reception.carrier_phase_cycles


class Transmission(Struct, frozen=True, gc=False):
    """One frame to be sent so that its RMARKER leaves the antenna at ``tx_ticks`` (40-bit, the sender's counter)."""

    frame: bytes
    tx_ticks: int
