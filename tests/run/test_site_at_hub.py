"""Real sites at a real hub of one server: each publishes its own, no tenant sees another, a number is given once."""

import asyncio
import json

import pytest
from nats.errors import NoRespondersError

from skyless.cli.main import main
from skyless.core.version import installed_version
from support.processes import SKYLESS, free_port, started
from support.small_hub import client_of, running_hub, site

pytestmark = pytest.mark.site


def apply(folder, capsys):
    capsys.readouterr()
    assert main(["hub", "apply", str(folder / "hub"), "--json"]) == 0
    return json.loads(capsys.readouterr().out)["tenants"]


async def test_a_site_publishes_its_own_and_no_tenant_sees_another(tmp_path, capsys):
    with running_hub(tmp_path) as (hub, _):
        async with site(tmp_path, hub.leaf("plant", 7)) as one, site(tmp_path, hub.leaf("other", 7)) as two:
            plant, other = await client_of(hub.address("plant")), await client_of(hub.address("other"))
            near, far = await client_of(one.nats), await client_of(two.nats)
            applying = asyncio.ensure_future(asyncio.to_thread(apply, tmp_path, capsys))
            while not applying.done():
                await near.publish("skyless.v2.7.summary", b"no summary")
                await asyncio.sleep(0.2)
            found = await applying
            assert found["plant"]["8"] is None
            assert found["plant"]["7"]["version"] == found["other"]["7"]["version"] == installed_version()
            seen, unseen, commands = await plant.subscribe("skyless.>"), await other.subscribe(">"), []
            heard = await near.subscribe("skyless.v1.7.*")
            for subject in ("skyless.v1.8.site", "skyless.v1.7.zones"):
                await plant.publish("skyless.v1.7.request", b"a command")
                await near.publish(subject, subject.encode())
            await far.publish("skyless.v1.7.assets", b"of the other tenant")
            subjects, others = set(), set()
            async with asyncio.timeout(30):
                while "skyless.v1.7.zones" not in subjects:
                    await near.publish("skyless.v1.7.zones", b"")
                    subjects.add((await seen.next_msg(20)).subject)
                while "skyless.v1.7.assets" not in others:
                    await far.publish("skyless.v1.7.assets", b"")
                    others.add((await unseen.next_msg(20)).subject)
            assert not any(subject.startswith(("skyless.v1.8", "skyless.v1.7.assets")) for subject in subjects)
            assert "skyless.v1.7.zones" not in others
            while heard.pending_msgs:
                commands.append((await heard.next_msg()).subject)
            assert "skyless.v1.7.request" not in commands
            stored = plant.jetstream()
            async with asyncio.timeout(60):
                while (await stored.stream_info("STATE_7")).state.messages == 0:
                    await asyncio.sleep(0.2)
            with pytest.raises(NoRespondersError):
                await plant.request("$JS.site7.API.STREAM.PURGE.STATE_7")
            for client in (plant, other, near, far):
                await client.close()


@pytest.mark.statistical
def test_a_number_that_another_site_has_is_refused(tmp_path, capsys):
    with running_hub(tmp_path):
        assert apply(tmp_path, capsys) == {"plant": {"7": None, "8": None}, "other": {"7": None}}
        leaf = tmp_path / "hub" / "sites" / "plant-site7.json"
        broker = (*SKYLESS, "broker", "--gather", "--keep-gb", "0.1", "--hub", str(leaf))
        with started(*broker, "--port", str(free_port()), "--data", str(tmp_path / "a")) as first:
            assert "the line to the hub is up" in first.stderr.readline()
            with started(*broker, "--port", str(free_port()), "--data", str(tmp_path / "b")) as second:
                lines = second.stderr.read()
                assert second.wait() == 2
            assert "--hub is of site 7, which is already at this hub" in lines.splitlines()[-1]
            assert apply(tmp_path, capsys)["plant"]["7"] is not None
            assert first.poll() is None


def test_a_wrong_password_and_a_hub_that_is_away_are_said_once_and_the_site_works(tmp_path, capsys):
    with running_hub(tmp_path) as (hub, server):
        leaf = tmp_path / "leaf.json"
        text = (tmp_path / "hub" / "sites" / "plant-site7.json").read_text()
        leaf.write_text(text.replace(hub.leaf("plant", 7).password, "x"))
        words = ("--gather", "--keep-gb", "0.1", "--hub", str(leaf), "--port", str(free_port()))
        with started(*SKYLESS, "broker", *words, "--data", str(tmp_path / "a")) as broker:
            assert broker.stdout.readline().startswith("mqtt://")
            assert "Authorization Violation" in broker.stderr.readline()
            server.kill()
            assert "connection refused" in broker.stderr.readline()
            broker.terminate()
            assert broker.stderr.read() == ""
