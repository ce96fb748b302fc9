"""Keys, codes and certificates against an implementation in shell and openssl (docs/authentication_vectors.sh)."""

import json
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from skyless.core.air.beacon import decode, signed_bytes, with_authentication
from skyless.core.keys import chain

DOCS = Path(__file__).parents[2] / "docs"
VECTORS = json.loads((DOCS / "authentication_vectors.json").read_text())
NAME = chain.SectionName(VECTORS["site"], VECTORS["serial"], VECTORS["section"])
TIMING = chain.ChainTiming(VECTORS["interval_ms"], VECTORS["lag"])


def raw(key):
    return bytes.fromhex(VECTORS[key])


def test_keys_of_a_section():
    assert chain.last_key(raw("seed"), NAME) == raw("last_key")
    assert chain.root_of(raw("seed"), NAME) == raw("root")
    assert chain.earlier_key(raw("last_key"), NAME, 2) == raw("interval_key")
    assert chain.mac_key(raw("interval_key"), NAME) == raw("mac_key")


def test_code_of_a_beacon():
    assert chain.mac_of(raw("signed_bytes"), raw("mac_key")) == raw("mac")
    assert chain.is_mac(raw("signed_bytes"), raw("mac"), raw("mac_key"))
    for bit in range(64):
        wrong = (int.from_bytes(raw("mac"), "big") ^ 1 << bit).to_bytes(8, "big")
        assert not chain.is_mac(raw("signed_bytes"), wrong, raw("mac_key"))


def test_the_beacon_of_the_document_with_its_code():
    unsigned = bytearray(raw("signed_bytes")[:-2])
    unsigned[11] &= ~0x04
    frame = with_authentication(bytes(unsigned) + bytes(2), VECTORS["interval"] & 0xFFFF, lambda _: raw("mac"))
    assert signed_bytes(frame) == raw("signed_bytes")
    decoded = decode(frame)
    assert decoded.authentication.mac == raw("mac")
    assert decoded.authentication.interval == VECTORS["interval"] & 0xFFFF
    assert (decoded.site, decoded.anchor, decoded.sequence) == (42, 300, 57)


def test_certificate():
    read = chain.read_certificate(VECTORS["site"], raw("certificate"))
    assert read is not None
    certificate, signature = read
    assert certificate == chain.Certificate(NAME, TIMING, VECTORS["first"], raw("root"))
    private = Ed25519PrivateKey.from_private_bytes(raw("private_key"))
    assert private.public_key().public_bytes_raw() == raw("public_key")
    assert chain.sign(certificate, private) == signature
    assert certificate.sent_bytes(signature) == raw("certificate")
    assert chain.is_signed(certificate, signature, chain.public_key(raw("public_key")))


def test_what_an_anchor_sends_with_that_seed():
    sections = range(VECTORS["section"] - 1, VECTORS["section"] + 1)
    private = Ed25519PrivateKey.from_private_bytes(raw("private_key"))
    signatures = chain.section_signatures(
        raw("seed"), VECTORS["site"], VECTORS["serial"], TIMING, VECTORS["first"], sections, private
    )
    own = chain.Chain(VECTORS["site"], VECTORS["serial"], TIMING, VECTORS["first"], signatures, raw("seed"))
    keys = chain.ChainKeys(own)
    assert keys.key(VECTORS["interval"]) == raw("interval_key")
    assert keys.mac_key(VECTORS["interval"]) == raw("mac_key")
    assert keys.certificate(VECTORS["interval"]) == raw("certificate")


@pytest.mark.parametrize("key", ["seed", "private_key"])
def test_a_chain_does_not_show_its_secrets(key):
    own = chain.Chain(42, 3, TIMING, 0, bytes(64), raw(key))
    for text in (repr(own), str(own), f"{own}"):
        assert VECTORS[key] not in text
        assert repr(raw(key)) not in text
