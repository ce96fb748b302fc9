"""One beacon as the positioning methods see it: every stamp unwrapped on its own clock."""

from msgspec import Struct

from skyless.core.arrays import Array


class Observation(Struct, frozen=True, gc=False):
    """A beacon received by the tag; integers never wrap."""

    anchor: int
    anchor_m: Array
    """Shape (3,)."""
    round: int
    """Counts the frames that each node sends: the superframe, or a fraction of it with several frames per node.

    For snapshots only, like the stamps of the master's beacon."""
    sequence: int
    rx_ticks_tag: int
    tx_ticks_anchor: int
    master_sequence: int | None
    """Sequence number of the last master beacon that the anchor received."""
    master_rx_ticks_anchor: int | None
    """The anchor's RX stamp of that beacon."""
    tx_ticks_master: int | None
    """TX time on the master's scale, whole ticks; None while the anchor does not know it."""
    tx_fraction_ticks: float
    tx_variance_m2: float
    """Variance of the TX time on the master's scale, from the anchor's clock filter."""
    relays: tuple[tuple[int, int, int], ...] = ()
    """The anchor's receptions of others: (anchor, sequence number, own RX stamp, unwrapped); for ``joint`` only."""
    report: tuple[int, int] | None = None
    """The anchor's report of its clock: the master, and its own reading minus the master's at its TX stamp in subticks
    modulo 2⁴⁸, with the variance ``tx_variance_m2``; for ``joint`` only."""
    rx_variance_factor: float = 1.0
    """Factor on the variance of this reception, at least 1, from the radio's diagnostics (``variance_factor``)."""
    packed_relays: bytes = b""
    """More relays, encoded as in frames (``beacon.packed_relays``)."""
    phase_cycles: float = -1.0
    """Carrier phase as the tag received it, negative if unknown; for ``joint`` only."""
    relay_phases: tuple[float, ...] = ()
    """Phases of ``relays``, as anchors received each other."""
