"""``skyless site keys``: make, replace and show the keys of a site, with which its beacons are verified."""

import multiprocessing
import os
import secrets
import signal
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from datetime import datetime
from itertools import repeat
from pathlib import Path
from typing import Annotated, Any, Final

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cyclopts import App
from msgspec.structs import replace

from skyless.arguments import Options, number
from skyless.cli.common import JsonOptions, command, console, print_facts, print_json, print_warnings, progress_bar
from skyless.cli.nodes.options import site_named
from skyless.core.errors import SkylessError, writing
from skyless.core.keys.chain import (
    CERTIFICATE_SIGNATURE_BYTES,
    SECTION_BITS,
    SEED_BYTES,
    USUAL_TIMING,
    Chain,
    ChainRing,
    section_signatures,
)
from skyless.core.site import Site
from skyless.files import replace_files
from skyless.machine import cores
from skyless.run.keys import (
    DAY_S,
    LITTLE_LEFT_S,
    MAX_SERIAL,
    SITE_PRIVATE,
    SITE_PUBLIC,
    SitePublic,
    chain_public_bytes,
    chain_public_file,
    chain_seed_file,
    private_bytes,
    read_chain_public,
    read_folder_public,
    read_private,
    seed_bytes,
    serials_in,
    site_public_bytes,
)

_YEAR_S: Final = 365.25 * DAY_S
_LATEST_S: Final = 20.0 * _YEAR_S
"""Latest begin of a chain, from now."""

_OVERLAP_S: Final = 5.0
"""A chain that starts at once begins this long ago, as the clocks of hosts differ."""


app = App(
    name="keys",
    help="Make, replace and show the keys of a site, with which its beacons are verified.",
    help_epilogue="Example: skyless site keys new site.toml",
)


class _KeysOptions(JsonOptions, frozen=True, kw_only=True):
    site: str
    """Site file, of mode free."""
    keys: Path | None = None
    """Folder of the site's keys; by default keys in that of the site file."""

    @property
    def plan(self) -> Site:
        """The site, of a mode whose beacons can carry codes. Raises SkylessError."""
        plan = site_named(self.site)
        if plan.schedule.needs_master:
            raise SkylessError(
                f'{self.site}: schedule.mode is "master", whose beacons carry no codes; it should be free'
            )
        return plan

    @property
    def folder(self) -> Path:
        """Folder of the keys."""
        return Path(self.site).parent / "keys" if self.keys is None else self.keys


class _ChainOptions(Options, frozen=True, kw_only=True):
    years: Annotated[float, number(above=0.0, most=10.0)] = 2.0
    """How long the chain lasts; a short one is made sooner."""


class _StartOptions(_ChainOptions, frozen=True, kw_only=True):
    starts: str | None = None
    """When the chain begins to count: ISO date and time, local where no zone is given; by default at once for new keys,
    else in a day. Until then anchors send without codes, or with those of the chain before, so that all of them can get
    the files."""


@app.command(help_epilogue='Example: skyless site keys new site.toml --starts "2030-01-31 06:00"')
@command
def new(asked: _KeysOptions, made: _StartOptions) -> None:
    """Make the keys of a site: its key pair and its first key chain. Nothing that is there is overwritten.

    Two years take five minutes of one processor; all are used.
    """
    plan, folder = asked.plan, asked.folder
    if folder.exists() and not folder.is_dir():
        raise SkylessError(f"{folder} is no folder; --keys should name a folder to make")
    present = [file for file in (folder / SITE_PRIVATE, folder / SITE_PUBLIC) if file.exists()]
    if present or (folder.is_dir() and serials_in(folder)):
        raise SkylessError(
            f"{folder} holds keys already; skyless site keys rotate makes another chain, --keys names another folder"
        )
    starts_s = time.time() - _OVERLAP_S if made.starts is None else _planned(made.starts)
    private = Ed25519PrivateKey.generate()
    public = SitePublic(plan.id, private.public_key().public_bytes_raw())
    chain = _made(public, 1, starts_s, made.years, private.private_bytes_raw())
    files = {folder / SITE_PRIVATE: private_bytes(private), folder / SITE_PUBLIC: site_public_bytes(public)}
    _write(folder, chain, files)
    _report_new(
        asked,
        chain,
        f"; fingerprint of the public key: {public.fingerprint}\n"
        f"next: 1. keep {SITE_PRIVATE} where only you can read it; no anchor and no tag needs it\n"
        f"2. copy {SITE_PUBLIC}, chain-1.public and chain-1.seed to each host of anchors: skyless anchor … --keys "
        "FOLDER\n"
        f"3. copy {SITE_PUBLIC} to each tag: skyless tag … --site-key {SITE_PUBLIC}",
    )


@app.command(help_epilogue='Example: skyless site keys rotate site.toml --starts "2030-01-31 06:00"')
@command
def rotate(asked: _KeysOptions, made: _StartOptions) -> None:
    """Make the next key chain of a site, which counts from a planned time on; until then the present one does."""
    public, chains = _present(asked)
    starts_s = time.time() + DAY_S if made.starts is None else _planned(made.starts)
    chain = _successor(asked.folder, public, chains, starts_s, made.years)
    _write(asked.folder, chain, {})
    warnings = []
    last = chains[-1]
    ends_s = last.ends_s
    if ends_s < starts_s:
        warnings.append(f"chain {last.serial} ends {_when(ends_s)}: until {_when(starts_s)} beacons carry no codes")
    _report_new(
        asked,
        chain,
        f"\nnext: copy chain-{chain.serial}.public and chain-{chain.serial}.seed to each host of anchors before it "
        "begins; anchors that run use them without a restart, and tags need nothing",
        warnings,
    )


@app.command(help_epilogue="Example: skyless site keys revoke site.toml --years 0.1")
@command
def revoke(asked: _KeysOptions, made: _ChainOptions) -> None:
    """Replace all key chains of a site at once, as a seed was stolen or an anchor's host lost."""
    public, chains = _present(asked)
    chain = _successor(asked.folder, public, chains, time.time() - _OVERLAP_S, made.years)
    raised = replace(public, least_serial=chain.serial)
    _write(asked.folder, chain, {asked.folder / SITE_PUBLIC: site_public_bytes(raised)})
    _report_new(
        asked,
        chain,
        "; chains before it are revoked\n"
        f"next: 1. copy chain-{chain.serial}.public and chain-{chain.serial}.seed at once to each host of anchors that "
        "you trust; anchors that run use them without a restart, and tags that receive them refuse the earlier chain\n"
        f"2. copy {SITE_PUBLIC} to each host of anchors and each tag, so that tags that were off refuse it as well\n"
        "3. delete the seeds of earlier chains",
    )


@app.command(help_epilogue="Example: skyless site keys show site.toml --json")
@command
def show(asked: _KeysOptions) -> None:
    """Show the key chains of a site: from when to when, and which counts now. No secret is shown."""
    public, chains = _present(asked)
    report = _report(asked.folder, public, chains, time.time())
    if asked.json:
        print_json(report)
        return
    rows = [("site", str(public.site)), ("public key", public.fingerprint)]
    for chain in report["chains"]:
        state = "revoked" if chain["is_revoked"] else "counts now" if chain["serial"] == report["present"] else ""
        seed = "" if chain["has_seed"] else "seed not here"
        span = f"{_when(chain['begins_unix_s'])} to {_when(chain['ends_unix_s'])}"
        rows.append((f"chain {chain['serial']}", ", ".join(filter(None, (span, state, seed)))))
    rows.append(("left", f"{report['days_left']:.0f} days"))
    print_facts(f"keys of site {public.site} ({asked.folder})", rows)
    print_warnings(report["warnings"])


def _report_new(asked: _KeysOptions, chain: Chain, next_steps: str, warnings: Sequence[str] = ()) -> None:
    """Print what was made and the next steps, or as JSON the same report as ``show``."""
    if asked.json:
        report = _report(asked.folder, *_present(asked), time.time())
        print_json({**report, "warnings": [*warnings, *report["warnings"]]})
        return
    span = f"from {_when(chain.begins_s)} to {_when(chain.ends_s)}"
    made = f"wrote chain {chain.serial} to {asked.folder}: it counts {span}"
    console().print(made + next_steps, markup=False, soft_wrap=True)
    print_warnings(warnings)


def _report(folder: Path, public: SitePublic, chains: list[Chain], now_s: float) -> dict[str, Any]:
    present = ChainRing(chains).serial_at(now_s)
    present = None if present is None or present < public.least_serial else present
    left_s = chains[-1].ends_s - now_s
    warnings = []
    if left_s < LITTLE_LEFT_S:
        end = f"ends in {left_s / DAY_S:.0f} days" if left_s > 0.0 else "has ended"
        warnings.append(f"the last chain {end}: run skyless site keys rotate, and copy its files to all anchors")
    if present is None and left_s > 0.0:
        warnings.append("no chain counts at present: beacons carry no codes")
    return {
        "site": public.site,
        "keys": folder,
        "fingerprint": public.fingerprint,
        "least_serial": public.least_serial,
        "present": present,
        "days_left": max(left_s, 0.0) / DAY_S,
        "chains": [
            {
                "serial": chain.serial,
                "begins_unix_s": chain.begins_s,
                "ends_unix_s": chain.ends_s,
                "sections": chain.sections,
                "is_revoked": chain.serial < public.least_serial,
                "has_seed": chain_seed_file(folder, chain.serial).exists(),
            }
            for chain in chains
        ],
        "warnings": warnings,
    }


# Parts of the commands


def _present(asked: _KeysOptions) -> tuple[SitePublic, list[Chain]]:
    """Read a site's public key and key chains, without their seeds. Raises SkylessError."""
    plan, folder = asked.plan, asked.folder
    public = read_folder_public(folder, plan.id)
    chains = [read_chain_public(folder, serial, plan.id) for serial in serials_in(folder)]
    if not chains:
        raise SkylessError(f"{folder} holds no chain-N.public; it should be the folder of skyless site keys new")
    return public, chains


def _successor(folder: Path, public: SitePublic, chains: list[Chain], starts_s: float, years: float) -> Chain:
    """Make the next chain of a site. Raises SkylessError."""
    private = read_private(folder, public)
    serial = max(chains[-1].serial, public.least_serial) + 1
    if serial > MAX_SERIAL:
        raise SkylessError(f"{folder} holds chain {MAX_SERIAL}, the last one; skyless site keys new makes new keys")
    return _made(public, serial, starts_s, years, private.private_bytes_raw())


def _made(public: SitePublic, serial: int, starts_s: float, years: float, private: bytes) -> Chain:
    with progress_bar("making the key chain") as reach:
        return new_chain(public.site, serial, starts_s, starts_s + years * _YEAR_S, private, reach)


def _write(folder: Path, chain: Chain, more: dict[Path, bytes]) -> None:
    """Write the files of a chain and others, all or none. Raises SkylessError."""
    seed, chain_public = chain_seed_file(folder, chain.serial), chain_public_file(folder, chain.serial)
    for file in (seed, chain_public):
        if file.exists():
            raise SkylessError(f"{file} is there already; nothing was written")
    with writing(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        files = {**more, seed: seed_bytes(chain), chain_public: chain_public_bytes(chain)}
        replace_files(files, secret=(folder / SITE_PRIVATE, seed))


def _planned(text: str) -> float:
    """Parse a future date and time to Unix time. Raises SkylessError."""
    try:
        starts_s = datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError):
        raise SkylessError(f'--starts is {text!r}; it should be a date and time, as "2030-01-31 06:00"') from None
    now_s = time.time()
    if not now_s <= starts_s <= now_s + _LATEST_S:
        side = "past" if starts_s < now_s else "far future"
        raise SkylessError(f"--starts is {text!r}, which is in the {side}; it should be within the next 20 years")
    return starts_s


def _when(unix_s: float) -> str:
    """Local date and time for people."""
    return datetime.fromtimestamp(unix_s).astimezone().strftime("%Y-%m-%d %H:%M:%S %Z")


_PIECE: Final = 64
"""Sections that a process makes at a time, which takes 0.3 s."""

_FEW: Final = 128
"""Up to this number, making sections is faster than starting processes."""


def new_chain(
    site: int, serial: int, starts_s: float, ends_s: float, private: bytes, reached: Callable[[float], None]
) -> Chain:
    """Make a chain with a new seed between two Unix times, the end rounded up to whole sections (14 minutes).

    ``private``: the site's private key, 32 bytes. ``reached`` is called with the share of the work done. An interrupt
    ends all processes.
    """
    seed = secrets.token_bytes(SEED_BYTES)
    first = USUAL_TIMING.interval_at(starts_s)
    begin, end = first >> SECTION_BITS, (USUAL_TIMING.interval_at(ends_s) >> SECTION_BITS) + 1
    pieces = [range(at, min(at + _PIECE, end)) for at in range(begin, end, _PIECE)]
    signatures = bytearray()

    def add(piece: bytes) -> None:
        signatures.extend(piece)
        reached(len(signatures) / CERTIFICATE_SIGNATURE_BYTES / (end - begin))

    work = (repeat(seed), repeat(site), repeat(serial), repeat(first), pieces, repeat(private))
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
    return Chain(site, serial, USUAL_TIMING, first, bytes(signatures), seed)


def _signatures(seed: bytes, site: int, serial: int, first: int, sections: range, private: bytes) -> bytes:
    key = Ed25519PrivateKey.from_private_bytes(private)
    return section_signatures(seed, site, serial, USUAL_TIMING, first, sections, key)


def _start_worker() -> None:
    """Ignore interrupts, which reach all processes of a terminal but concern the parent, and end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
