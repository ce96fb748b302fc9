"""The tag's side of the paper, and the bracketed form of it, one anchor at a time.

Stamps are unwrapped integers, each on its own clock: ``m`` the master's TX stamps, ``s`` the anchor's RX stamps of the
same two master messages, ``a`` the anchor's own TX stamps, ``r`` the tag's RX stamps of the anchor's two messages
and ``rm`` those of the master's.
"""

from skyless.clocks.paper import synchronise, to_master
from skyless.kernels.compiled import kernel


@kernel
def tag_rate(rx_interval_tag: float, tx_interval_master: float) -> float:
    """Rate ν̄_m of the tag against the master (``eq:TagSynchro``); the motion toward the anchor is in it."""
    return rx_interval_tag / tx_interval_master


@kernel
def protocol_interval(rate_tag: float, tx_anchor_master: float, tx_master: float) -> float:
    """Protocol interval g(Δ_{i,m}) as the tag's clock would show it, in ticks (``eq:ProtocolInterval``)."""
    return rate_tag * (tx_anchor_master - tx_master)


@kernel
def literal_tdoa(
    m1: int,
    m2: int,
    s1: int,
    s2: int,
    a1: int,
    a2: int,
    r1: int,
    r2: int,
    rm1: int,
    rm2: int,
    tof_ticks: float,
) -> tuple[float, float]:
    """TDoAs of the first and of the delayed messages in ticks of the tag (``eq:GPSTDoA``), to the letter.

    Both stamps of the anchor's pair are converted with the same synchronisation; converting each with the newest one
    doubles the error (``docs/maths.md`` section 5, "the trap").
    """
    rate, offset = synchronise(m1, m2, s1, s2, tof_ticks)
    first = to_master(float(a1 - s1), rate, offset)
    delayed = to_master(float(a2 - s1), rate, offset)
    rate_tag = tag_rate(float(r2 - r1), delayed - first)
    tdoa_first = (r1 - rm1) - protocol_interval(rate_tag, first, 0.0)
    tdoa_delayed = (r2 - rm2) - protocol_interval(rate_tag, delayed, float(m2 - m1))
    return tdoa_first, tdoa_delayed


@kernel
def bracketed_tdoa(
    m1: int, m2: int, s1: int, s2: int, a1: int, a2: int, r1: int, r2: int, rm2: int, tof_ticks: float
) -> float:
    """TDoA in ticks against the master's second message, which the anchor's two enclose (``docs/maths.md`` section 5).

    The anchor's own RX stamp of that message says where between its two transmissions it was sent; no
    synchronisation parameter enters but the rate that scales the flight time.
    """
    rate = float(s2 - s1) / float(m2 - m1)
    sent_after_first = (s2 - a1) - rate * tof_ticks
    return (r1 - rm2) + float(r2 - r1) / float(a2 - a1) * sent_after_first
