"""Makes a key chain on all processors: two years take some minutes of one."""

import multiprocessing
import os
import secrets
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from typing import Final

from skyless.authentication.certificate import CERTIFICATE_SIGNATURE_BYTES, USUAL_TIMING, ChainTiming
from skyless.authentication.chain import Chain, section_signatures
from skyless.authentication.key_chain import SECTION_BITS, SEED_BYTES
from skyless.kernels.processors import cores

_PIECE: Final = 64
"""Sections that a process makes at a time: 0.3 s."""

_FEW: Final = 128
"""Sections that are made sooner than processes start."""


def new_chain(
    site: int,
    serial: int,
    starts_s: float,
    ends_s: float,
    private: bytes,
    reached: Callable[[float], None],
    timing: ChainTiming = USUAL_TIMING,
) -> Chain:
    """A chain with a new seed between two Unix times, whose end is rounded up to whole sections (14 minutes).

    ``private``: the site's private key, 32 bytes. ``reached`` is called with the share of the work that is done.
    An interrupt ends all processes.
    """
    seed = secrets.token_bytes(SEED_BYTES)
    first = timing.interval_at(starts_s)
    begin, end = first >> SECTION_BITS, (timing.interval_at(ends_s) >> SECTION_BITS) + 1
    pieces = [range(at, min(at + _PIECE, end)) for at in range(begin, end, _PIECE)]
    signatures = bytearray()

    def add(piece: bytes) -> None:
        signatures.extend(piece)
        reached(len(signatures) / CERTIFICATE_SIGNATURE_BYTES / (end - begin))

    work = (repeat(seed), repeat(site), repeat(serial), repeat(timing), repeat(first), pieces, repeat(private))
    if end - begin <= _FEW:
        for piece in map(_signatures, *work):
            add(piece)
    else:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(min(cores(), len(pieces)), context, _start_worker) as pool:
            try:
                for piece in pool.map(_signatures, *work):
                    add(piece)
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    return Chain(site, serial, timing, first, bytes(signatures), seed)


def _signatures(
    seed: bytes, site: int, serial: int, timing: ChainTiming, first: int, sections: range, private: bytes
) -> bytes:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415 - loads OpenSSL

    key = Ed25519PrivateKey.from_private_bytes(private)
    return section_signatures(seed, site, serial, timing, first, sections, key)


def _start_worker() -> None:
    """An interrupt reaches all processes of a terminal; the parent alone acts on it. A worker ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
