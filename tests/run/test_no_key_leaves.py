"""Nothing that programs with keys write or send holds a seed, or a key that is not disclosed yet.

Anchors, a tag and a recorder run as processes at a broker; the chain is replaced while they run. What is searched: all
lines, all payloads on MQTT, the recording and what the tag remembers.
"""

import base64
import os
import time

import pytest
from mcap.reader import make_reader
from site_programs import START_S, Program, together

from skyless.cli.main import main
from skyless.core.keys.chain import ChainKeys
from skyless.run.keys import read_keys
from skyless.run.mqtt.link import Link
from support.mqtt_brokers import Embedded, running
from support.processes import free_port
from support.waiting import until

pytestmark = pytest.mark.site

SITE = 300
TOPICS = f"skyless/v1/{SITE}/"
ANCHORS = (1, 2, 3, 4)


def forms(secret):
    """A secret as it might be written: as it is, in hexadecimal, in base64 at any place of something longer."""
    yield from (secret, secret.hex().encode(), secret.hex().upper().encode())
    for before in range(3):
        for code in (base64.b64encode, base64.urlsafe_b64encode):
            yield code(bytes(before) + secret)[(4 * before + 2) // 3 : 4 * (before + len(secret)) // 3]


def secrets_after(keys, private, unix_s):
    """Seeds, the private key, and keys of intervals that were not disclosed by that time."""
    found = [chain.seed for chain in keys.chains] + [private]
    for chain in keys.chains:
        made, timing = ChainKeys(chain), chain.timing
        first = max(timing.interval_at(unix_s) + 1, chain.first)
        found += [made.key(interval) for interval in range(first, min(first + 400, chain.end))]
        found.append(made.key(chain.end - 1))
    return found


@pytest.mark.parametrize("before", range(4))
def test_a_secret_is_found_wherever_it_stands(before):
    secret = bytes(range(240, 256))
    data = b"before"[:before] + secret + b"after"
    for written in (data, data.hex().encode(), base64.b64encode(data), base64.urlsafe_b64encode(data)):
        assert any(one in written for one in forms(secret))
        assert not any(one in written for one in forms(secret[::-1]))


def recorded(file):
    """All bytes of a recording, whose messages may be compressed."""
    with file.open("rb") as opened:
        messages = [message.data for _, _, message in make_reader(opened).iter_messages()]
    return b"\n".join([file.read_bytes(), *messages])


@pytest.fixture
def site(tmp_path):
    file = tmp_path / "hall.toml"
    size = ["--width", "20", "--depth", "20", "--spacing", "10", "--site-id", str(SITE)]
    assert main(["site", "new", str(file), *size]) == 0
    assert main(["site", "keys", "new", str(file), "--years", "0.0001"]) == 0
    return file


@pytest.mark.statistical
async def test_no_key_leaves_the_programs(site, tmp_path):
    seen = []
    broker = Embedded(tmp_path)
    air, mqtt = f"127.0.0.1:{free_port()}", ("--mqtt", str(broker.address))
    keys, radio = tmp_path / "keys", ("--radio", f"ether:{air}")
    home = os.environ | {"XDG_DATA_HOME": str(tmp_path / "data")}
    anchors = Program("anchor", *ANCHORS, "--site", site, *radio, *mqtt, "--keys", keys)
    key = ("--site-key", keys / "site.public", "--trust", "verified", "--json")
    tag = Program("tag", "tag1", *radio, *mqtt, *key, environment=home)
    programs = [
        Program("ether", "--site", site, "--tags", 1, "--listen", air, *mqtt),
        anchors,
        tag,
        Program("record", tmp_path / "walk.mcap", *mqtt),
    ]
    observer = Link(broker.address, "observer", site=SITE, kind="watch")
    observer.subscribe(f"{TOPICS}#", lambda topic, payload: seen.append((topic, bytes(payload))))
    async with running(broker, observer), together(programs) as lines:
        await tag.heard("are verified (key chain 1)")
        await until(lambda: sum(topic.endswith("receptions") for topic, _ in seen) > 10, START_S)
        assert main(["site", "keys", "revoke", str(site), "--years", "0.0001"]) == 0
        await tag.heard("are verified (key chain 2)")
        count = len(seen)
        await until(lambda: sum(topic.endswith("fix") for topic, _ in seen[count:]) > 50, START_S)
    ended_s = time.time()
    written = {
        "lines": "\n".join(lines).encode(),
        "recording": recorded(tmp_path / "walk.mcap"),
        "memory": b"".join(file.read_bytes() for file in (tmp_path / "data" / "skyless" / "trust").iterdir()),
        "mqtt": b"\n".join(payload for _, payload in seen),
    }
    assert all(written.values())
    assert len(seen) > 100
    keys = read_keys(tmp_path / "keys", SITE, {})
    pem = (tmp_path / "keys" / "site.private").read_text().splitlines()[1]
    secrets = secrets_after(keys, base64.b64decode(pem)[-32:], ended_s)
    assert len(secrets) > 400
    found = [(name, form) for name, data in written.items() for one in secrets for form in forms(one) if form in data]
    assert found == []
    made = ChainKeys(keys.chains[-1])
    present = keys.chains[-1].timing.interval_at(ended_s)
    disclosed = [made.key(interval) for interval in range(present - 100, present)]
    for name in ("mqtt", "recording"):  # what is sent is seen
        assert any(form in written[name] for one in disclosed for form in forms(one)), name
