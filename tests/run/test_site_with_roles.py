"""A site whose programs have roles and TLS, as ``docs/howto/secure_a_site.md`` makes them: nothing is refused."""

import os
import re
import shlex
import shutil
import subprocess
from pathlib import Path

import msgspec
import pytest
from site_programs import START_S, Program, site_file, together

from skyless.core.errors import SkylessError
from skyless.run.mqtt.address import MqttAddress, Role, create_access, read_access
from skyless.run.mqtt.connection import check_broker
from skyless.run.mqtt.link import Link
from support.mqtt_brokers import Embedded, running
from support.processes import free_port
from support.waiting import until

pytestmark = pytest.mark.site

HOWTO = Path(__file__).parents[2] / "docs" / "howto" / "secure_a_site.md"
SITE = "skyless/v1/77/"


def make_certificate(folder):
    """The certificate and key of the line in the how-to, for this machine."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    (line,) = re.findall(r"^openssl req (?:.*\\\n)*.*$", HOWTO.read_text(encoding="utf-8"), re.MULTILINE)
    line = line.replace("\\\n", " ").replace("DNS:hall.local", "DNS:localhost,IP:127.0.0.1")
    folder.mkdir(exist_ok=True)
    subprocess.run(shlex.split(line), check=True, capture_output=True, cwd=folder)
    assert (folder / "key.pem").stat().st_mode & 0o077 == 0
    return folder / "certificate.pem", folder / "key.pem"


@pytest.fixture
def broker(tmp_path):
    """A broker with roles and TLS, not yet started."""
    certificate, key = make_certificate(tmp_path)
    create_access(tmp_path / "passwords", MqttAddress("127.0.0.1", 1883))
    roles = read_access(tmp_path / "passwords")
    return Embedded(tmp_path, roles=roles, certificate=certificate, key=key)


def address_of(broker, role, ca):
    password = broker.settings.roles[role]
    return msgspec.structs.replace(broker.address, user=str(role), password=password, ca=ca)


async def test_a_broker_with_another_certificate_gets_no_password(broker, tmp_path):
    await broker.start()
    await check_broker(address_of(broker, Role.TAGS, tmp_path / "certificate.pem"))
    other, _ = make_certificate(tmp_path / "other")
    with pytest.raises(SkylessError, match=r"certificate of the broker mqtts://tags@.* is not trusted"):
        await check_broker(address_of(broker, Role.TAGS, other))
    await broker.stop()


def test_a_shell_reads_the_file_of_a_role(broker, tmp_path):
    shell = "set -a; . passwords/tags.env; set +a; env"
    said = subprocess.run(["sh", "-c", shell], check=True, capture_output=True, text=True, cwd=tmp_path).stdout
    assert "SKYLESS_MQTT=mqtt://tags@127.0.0.1:1883\n" in said
    assert f"SKYLESS_MQTT_PASSWORD={broker.settings.roles[Role.TAGS]}\n" in said


@pytest.mark.statistical
async def test_the_programs_of_a_site_may_do_all_that_they_do(broker, tmp_path):
    def program(role, *arguments):
        password = {"SKYLESS_MQTT": f"mqtts://{role}@127.0.0.1:{broker.address.port}"}
        password |= {
            "SKYLESS_MQTT_PASSWORD": broker.settings.roles[role],
            "SKYLESS_MQTT_CA": str(tmp_path / "certificate.pem"),
        }
        return Program(*arguments, environment=os.environ | password)

    site, air = ("--site", site_file(tmp_path)), f"127.0.0.1:{free_port()}"
    mqtts = ("--mqtt", f"mqtts://survey@127.0.0.1:{broker.address.port}")
    programs = [
        program(Role.ANCHORS, "ether", *site, "--tags", 1, "--listen", air),
        program(Role.ANCHORS, "anchor", *range(1, 8), *site, "--radio", f"ether:{air}"),
        program(Role.TAGS, "tag", "tag1", "--radio", f"ether:{air}"),
        program(Role.PAGE, "dashboard", "--listen", f"127.0.0.1:{free_port()}"),
        program(Role.PAGE, "record", tmp_path / "walk.mcap"),
        program(Role.SURVEY, "survey", "--serve", *mqtts, "--mqtt-ca", tmp_path / "certificate.pem"),
        program(Role.PAGE, "bridge", f"jsonl+tcp://127.0.0.1:{free_port()}"),
    ]
    seen = set()
    observer = Link(address_of(broker, Role.OPERATOR, tmp_path / "certificate.pem"), "observer", site=77, kind="watch")
    observer.subscribe(f"{SITE}#", lambda topic, _: seen.add(topic.removeprefix(SITE)))
    async with running(broker, observer), together(programs) as lines:
        await until(lambda: kinds(seen) >= EXPECTED, START_S)
    assert not [line for line in lines if "does not let" in line or "refuses" in line]
    assert "Violation" not in (tmp_path / "store" / "nats-server.log").read_text(encoding="utf-8")


def kinds(topics):
    """Topics without the names of dashboards and others that are made from the machine's."""
    return {re.sub(r"^(dashboard|recorder|survey|bridge)/[^/]+/status$", r"\1/status", topic) for topic in topics}


EXPECTED = {
    *("site", "request", "truth", "survey/state", "survey/watch", "ether/air/health", "ether/air/status"),
    *("tag/tag1/fix", "tag/tag1/health", "tag/tag1/status", "tag/tag1/receptions"),
    *(f"anchor/{anchor}/{what}" for anchor in range(1, 8) for what in ("health", "status", "stamps")),
    *(f"{kind}/status" for kind in ("dashboard", "recorder", "survey", "bridge")),
}
