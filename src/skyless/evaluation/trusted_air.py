"""A simulated site whose anchors have keys: what its tags receive, for tests and benchmarks of authentication."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Final

from msgspec import Struct

from skyless.air.reception import Reception, Transmission
from skyless.anchors.authentication import BeaconAuthentication
from skyless.anchors.factory import AnyAnchor, new_anchor
from skyless.authentication.certificate import USUAL_TIMING, ChainTiming
from skyless.authentication.chain import Chain, section_signatures
from skyless.authentication.key_chain import SECTION_BITS, SEED_BYTES
from skyless.site.model import Site

START_UNIX_S: Final = 1_800_000_000.0
"""Unix time at which simulated time begins."""


class MadeKeys(Struct, frozen=True):
    """Keys of a simulated site."""

    public: bytes
    chains: tuple[Chain, ...]


def made_keys(
    site: int, *starts_s: float, sections: int = 2, timing: ChainTiming = USUAL_TIMING, number: int = 1
) -> MadeKeys:
    """Keys of a site with a chain from each of these simulated times on. They follow from the number: no secret."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415 - loads OpenSSL

    private = Ed25519PrivateKey.from_private_bytes(number.to_bytes(SEED_BYTES, "little"))
    chains = []
    for serial, start_s in enumerate(starts_s, start=1):
        first = timing.interval_at(START_UNIX_S + start_s)
        covered = range(first >> SECTION_BITS, (first >> SECTION_BITS) + sections)
        seed = (number << 16 | serial).to_bytes(SEED_BYTES, "big")
        signatures = section_signatures(seed, site, serial, timing, first, covered, private)
        chains.append(Chain(site, serial, timing, first, signatures, seed))
    return MadeKeys(private.public_key().public_bytes_raw(), tuple(chains))


class ClockedAnchor:
    """An anchor whose host has a clock: the simulation's, ahead by an error."""

    def __init__(self, machine: AnyAnchor, now_s: Callable[[], float], error_s: float = 0.0) -> None:
        self.id, self.machine = machine.id, machine
        self._now_s, self._error_s = now_s, error_s

    def hear(self, reception: Reception) -> None:
        """As ``AnchorMachine``."""
        self.machine.hear(reception)

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """As ``AnchorMachine``; the host's clock is read as well."""
        authentication = getattr(self.machine, "authentication", None)
        if authentication is not None:
            authentication.set_time(now_ticks, START_UNIX_S + self._now_s() + self._error_s)
        return self.machine.next_transmission_ticks(now_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        """As ``AnchorMachine``."""
        return self.machine.transmission(tx_ticks)


def anchors_with_keys(
    site: Site,
    now_s: Callable[[], float],
    chains: Sequence[Chain],
    *,
    others: Mapping[int, Sequence[Chain]] = MappingProxyType({}),
    errors_s: Mapping[int, float] = MappingProxyType({}),
) -> Callable[[int], ClockedAnchor]:
    """Makes a site's anchors: with these chains, some with others, and with clocks that are ahead."""

    def new(anchor: int) -> ClockedAnchor:
        authentication = BeaconAuthentication(site, others.get(anchor, chains), no_keys_s=0.0)
        return ClockedAnchor(new_anchor(site, anchor, 1e-3, authentication), now_s, errors_s.get(anchor, 0.0))

    return new
