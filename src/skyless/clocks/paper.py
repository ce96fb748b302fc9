"""The paper's clock model and two-message synchronisation (Santoro et al., ROSE 2021).

The arithmetic is the paper's; only the origin differs. The paper's readings count from the start of each clock,
and at 40 bits and more their products lose ticks in float64. Here every reading is counted, as an integer, from
the first synchronisation message, which leaves the method as it stands and its rounding error below 1e-10 mm.
"""

from dataclasses import dataclass

from skyless.kernels.compiled import part


@dataclass(frozen=True, slots=True)
class LinearClock:
    """A clock with constant offset and rate (``eq:TauMaster``, ``eq:TauAnchor``, ``eq:TauTag``)."""

    offset_ticks: float
    rate: float
    """Normalised rate ν, 1 for a perfect oscillator."""

    def read(self, true_ticks: float) -> float:
        """Reading, in ticks, at a true time counted in ticks."""
        return self.offset_ticks + self.rate * true_ticks


@part
def relative_rate(rx_interval_anchor: float, tx_interval_master: float) -> float:
    """Relative rate ν̄_{i,m} of an anchor against the master from two messages (``eq:Synchro``)."""
    return rx_interval_anchor / tx_interval_master


@part
def relative_offset(rx_anchor: float, tx_master: float, rate: float, tof_ticks: float) -> float:
    """Relative offset ō_{i,m} of one synchronisation message, in ticks (``eq:SynchroOffset``)."""
    return rx_anchor - rate * tx_master - tof_ticks


@part
def averaged_offset(first: float, delayed: float) -> float:
    """Mean of the offsets of the two messages (``eq:AverageRelOff``).

    With one two-point rate both are identical for any noise (``docs/maths.md`` E2): averaging changes nothing.
    """
    return (first + delayed) / 2.0


@part
def to_master(ticks_anchor: float, rate: float, offset: float) -> float:
    """An anchor's reading on the master's scale (``eq:AnchorSync``), in ticks."""
    return (ticks_anchor - offset) / rate


@part
def synchronise(
    tx1_master: int, tx2_master: int, rx1_anchor: int, rx2_anchor: int, tof_ticks: float
) -> tuple[float, float]:
    """Rate and averaged offset of an anchor from two master messages.

    The offset holds for master readings counted from ``tx1_master`` and anchor readings from ``rx1_anchor``.
    """
    tx_interval = float(tx2_master - tx1_master)
    rx_interval = float(rx2_anchor - rx1_anchor)
    rate = relative_rate(rx_interval, tx_interval)
    first = relative_offset(0.0, 0.0, rate, tof_ticks)
    delayed = relative_offset(rx_interval, tx_interval, rate, tof_ticks)
    return rate, averaged_offset(first, delayed)
