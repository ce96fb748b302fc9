"""Files of a site's keys: what is written is read again, and what is damaged, foreign or open to others is refused."""

import os
import re

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.cli.site_keys import new_chain
from skyless.core.errors import SkylessError
from skyless.core.keys.chain import SECTION_BITS, Chain, ChainTiming
from skyless.run.keys import (
    SEEDS_VARIABLE,
    SITE_PRIVATE,
    SITE_PUBLIC,
    SitePublic,
    chain_public_bytes,
    chain_public_file,
    chain_seed_file,
    parse_seeds,
    private_bytes,
    read_chain_public,
    read_keys,
    read_private,
    read_site_public,
    seed_bytes,
    serials_in,
    site_public_bytes,
)

pytestmark = pytest.mark.site

SITE = 300
PRIVATE = Ed25519PrivateKey.generate()
PUBLIC = SitePublic(SITE, PRIVATE.public_key().public_bytes_raw())
CHAINS = tuple(
    new_chain(SITE, serial, 1.8e9, 1.8e9 + 1000.0, PRIVATE.private_bytes_raw(), lambda _: None) for serial in (1, 2)
)


def secret(file, data):
    file.write_bytes(data)
    file.chmod(0o600)


@pytest.fixture
def folder(tmp_path):
    """Keys with two chains."""
    secret(tmp_path / SITE_PRIVATE, private_bytes(PRIVATE))
    (tmp_path / SITE_PUBLIC).write_bytes(site_public_bytes(PUBLIC))
    for chain in CHAINS:
        chain_public_file(tmp_path, chain.serial).write_bytes(chain_public_bytes(chain))
        secret(chain_seed_file(tmp_path, chain.serial), seed_bytes(chain))
    return tmp_path


def refused(folder, words, *, site=SITE, seeds=None):
    with pytest.raises(SkylessError) as raised:
        read_keys(folder, site, seeds or {})
    message = str(raised.value)
    assert re.search(words, message), message
    assert "\n" not in message
    for chain in CHAINS:
        assert chain.seed.hex() not in message


def test_what_is_written_is_read(folder):
    keys = read_keys(folder, SITE, {})
    assert (keys.public, keys.chains, keys.without_seed) == (PUBLIC, CHAINS, ())
    assert read_private(folder, PUBLIC).private_bytes_raw() == PRIVATE.private_bytes_raw()
    assert serials_in(folder) == (1, 2)


@given(
    serial=st.integers(1, 0xFFFF),
    interval_ms=st.integers(10, 10_000),
    lag=st.integers(4, 255),
    first=st.integers(0, (1 << 40) - 1),
    signatures=st.lists(st.binary(min_size=64, max_size=64), min_size=1, max_size=5),
)
def test_any_chain_is_read_as_it_was_written(tmp_path_factory, serial, interval_ms, lag, first, signatures):
    timing = ChainTiming(interval_ms, lag)
    chain = Chain(SITE, serial, timing, first, b"".join(signatures), b"")
    folder = tmp_path_factory.getbasetemp()
    chain_public_file(folder, serial).write_bytes(chain_public_bytes(chain))
    if (first >> SECTION_BITS) + len(signatures) <= 1 << 32:
        assert read_chain_public(folder, serial, SITE) == chain
    chain_public_file(folder, serial).unlink()


def test_keys_of_0_2_are_refused_with_what_to_do(tmp_path):
    chain = replace(CHAINS[0], timing=ChainTiming(100, 3))
    chain_public_file(tmp_path, chain.serial).write_bytes(chain_public_bytes(chain))
    with pytest.raises(SkylessError, match=r"lag.*3.*should be 4 or more: make new keys \(skyless site keys new\)"):
        read_chain_public(tmp_path, chain.serial, SITE)


@given(st.builds(SitePublic, st.integers(0, 0xFFFF), st.binary(min_size=32, max_size=32), st.integers(0, 0xFFFF)))
def test_any_public_key_is_read_as_it_was_written(tmp_path_factory, public):
    file = tmp_path_factory.getbasetemp() / SITE_PUBLIC
    file.write_bytes(site_public_bytes(public))
    assert read_site_public(file) == public


@given(st.data())
def test_a_changed_or_cut_chain_is_refused(tmp_path_factory, data):
    whole = chain_public_bytes(CHAINS[0])
    at = data.draw(st.integers(0, len(whole) - 1))
    flipped = bytes([*whole[:at], whole[at] ^ data.draw(st.integers(1, 255)), *whole[at + 1 :]])
    folder = tmp_path_factory.getbasetemp()
    for damaged in (flipped, whole[:at], whole + bytes(at + 1)):
        chain_public_file(folder, 1).write_bytes(damaged)
        with pytest.raises(SkylessError, match=r"chain-1\.public"):
            read_chain_public(folder, 1, SITE)


@given(st.binary(max_size=300))
def test_any_bytes_as_a_public_key_give_one_line(tmp_path_factory, data):
    file = tmp_path_factory.getbasetemp() / SITE_PUBLIC
    file.write_bytes(data)
    with pytest.raises(SkylessError, match=r"site\.public") as raised:
        read_site_public(file)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("site = 70000", "site is 70000; it should be 0 to 65535"),
        ('site = "1"', "site"),
        ('public_key = "12"', "public_key is .12.; it should be 64 hexadecimal digits"),
        ("least_serial = -1", "least_serial is -1"),
        ("least_seriall = 1", "least_seriall"),
    ],
)
def test_a_wrong_value_is_named(folder, line, words):
    file = folder / SITE_PUBLIC
    key = line.split(" ", 1)[0].removesuffix("l")
    key = "least_serial" if key == "least_seria" else key
    file.write_text(re.sub(rf"(?m)^{key} = .*$", line, file.read_text()))
    refused(folder, words)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o620, 0o644])
def test_a_secret_that_others_can_read_is_refused_with_what_to_do(folder, mode):
    for file in (chain_seed_file(folder, 2), folder / SITE_PRIVATE):
        file.chmod(mode)
    refused(folder, r"chain-2\.seed is a secret that others can read; run: chmod 600 .*chain-2\.seed")
    with pytest.raises(SkylessError, match=r"chmod 600 .*site\.private"):
        read_private(folder, PUBLIC)


def test_files_of_another_site_and_others_seeds_are_refused(folder):
    refused(folder, r"site\.public is of site 300; it should be of site 301", site=301)
    other = replace(CHAINS[1], site=301)
    chain_public_file(folder, 2).write_bytes(chain_public_bytes(other))
    refused(folder, "is chain 2 of site 301; it should be chain 2 of site 300")
    chain_public_file(folder, 2).write_bytes(chain_public_bytes(CHAINS[0]))
    refused(folder, "is chain 1 of site 300; it should be chain 2 of site 300")
    chain_public_file(folder, 2).write_bytes(chain_public_bytes(CHAINS[1]))
    secret(chain_seed_file(folder, 2), seed_bytes(CHAINS[0]))
    refused(folder, r"chain-2\.public does not belong to its seed or to site\.public")
    secret(chain_seed_file(folder, 2), b"12\n")
    refused(folder, r"chain-2\.seed: it should be 64 hexadecimal digits")


def test_a_private_key_must_be_that_of_the_public_one(folder):
    secret(folder / SITE_PRIVATE, private_bytes(Ed25519PrivateKey.generate()))
    with pytest.raises(SkylessError, match="is not the private key of"):
        read_private(folder, PUBLIC)
    other = X25519PrivateKey.generate().private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    for data in (b"", b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n", other):
        secret(folder / SITE_PRIVATE, data)
        with pytest.raises(SkylessError, match=r"site\.private: it should be"):
            read_private(folder, PUBLIC)


def test_what_is_missing_is_named(folder, tmp_path):
    refused(tmp_path / "none", "none is no folder")
    chain_seed_file(folder, 2).unlink()
    assert read_keys(folder, SITE, {}).without_seed == (2,)
    (folder / SITE_PUBLIC).write_bytes(site_public_bytes(replace(PUBLIC, least_serial=2)))
    refused(folder, rf"chain-2\.seed is missing; .* or put the seed in {SEEDS_VARIABLE}")
    for chain in CHAINS:
        chain_public_file(folder, chain.serial).unlink()
    refused(folder, r"chain-2\.public and .*chain-2\.seed are missing")
    (folder / SITE_PUBLIC).unlink()
    refused(folder, r"site\.public is missing")


def test_a_device_or_a_pipe_is_no_file_of_keys(folder):
    chain_seed_file(folder, 2).unlink()
    os.mkfifo(chain_seed_file(folder, 2), 0o600)
    refused(folder, r"chain-2\.seed is no file")


def test_seeds_may_come_from_the_environment(folder):
    text = " ".join(f"{chain.serial}:{chain.seed.hex().upper()}" for chain in CHAINS)
    for chain in CHAINS:
        chain_seed_file(folder, chain.serial).unlink()
    assert read_keys(folder, SITE, parse_seeds(text)).chains == CHAINS
    assert parse_seeds("") == {}
    refused(folder, r"chain-2\.public does not belong to its seed", seeds=parse_seeds(text) | {2: CHAINS[0].seed})


@pytest.mark.parametrize("entry", ["{}", "1:{}0", "1:", "x:{}", "0:{}", "70000:{}", "1={}", "2 {}"])
def test_a_wrong_entry_in_the_environment_is_not_shown(entry):
    text = entry.format(CHAINS[0].seed.hex())
    with pytest.raises(SkylessError, match=f"{SEEDS_VARIABLE}: entry [12] cannot be read") as raised:
        parse_seeds(f"9:{CHAINS[1].seed.hex()} {text}" if entry == "{}" else text)
    for chain in CHAINS:
        assert chain.seed.hex() not in str(raised.value)
