"""The embedded broker: its address, its privacy, its end."""

import asyncio
import contextlib
import fcntl
import json
import os
import re
import signal

import msgspec
import pytest

from skyless.cli.main import main
from skyless.cli.nodes import broker as broker_command
from skyless.cli.nodes.options import MqttOptions
from skyless.core.errors import SkylessError
from skyless.run import broker as broker_module
from skyless.run.broker import BrokerSettings, StatedAddress, running_broker, start_broker
from skyless.run.mqtt.address import MqttAddress, mqtt_address
from skyless.run.mqtt.connection import check_broker, kept_messages
from skyless.run.mqtt.link import Link
from support.mqtt_brokers import stopped
from support.processes import SKYLESS, free_port, lives, started
from support.waiting import came, running, until

pytestmark = pytest.mark.site


@pytest.fixture
def port():
    return free_port()


@contextlib.contextmanager
def program(*options):
    """``skyless broker``, and what it says when it is ready."""
    with started(*SKYLESS, "broker", "--json", *options, stderr=None) as process:
        yield process, json.loads(process.stdout.readline())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_it_leaves_no_orphan_however_it_ends(number, port, tmp_path):
    with program("--port", str(port), "--data", str(tmp_path / "store")) as (process, ready):
        assert ready["mqtt"] == f"mqtt://127.0.0.1:{port}"
        assert lives(ready["pid"])
        process.send_signal(number)
        assert process.wait(20) == (-9 if number == signal.SIGKILL else 0)
        came(lambda: not lives(ready["pid"]))


def test_it_is_an_error_when_nats_server_dies(port, tmp_path):
    with program("--port", str(port), "--data", str(tmp_path / "store")) as (process, ready):
        os.kill(ready["pid"], signal.SIGKILL)
        assert process.wait(20) == 2


async def test_its_store_is_private(port, tmp_path):
    settings = BrokerSettings(port=port, data=tmp_path / "store", user="ann", password='pä"\\ss#$ word')
    async with await start_broker(settings) as broker:
        assert (tmp_path / "store").stat().st_mode & 0o777 == 0o700
        assert (tmp_path / "store" / "nats-server.conf").stat().st_mode & 0o777 == 0o600
        assert "ss#" not in str(broker.address)
        await check_broker(broker.address)
        with pytest.raises(SkylessError, match="password"):
            await check_broker(msgspec.structs.replace(broker.address, user=None, password=None))
        with pytest.raises(SkylessError, match="another broker uses"):
            await start_broker(BrokerSettings(data=tmp_path / "store"))


async def test_retained_messages_survive_its_death(port, tmp_path):
    """Once it has written them: nats-server acknowledges a retained message some milliseconds before that."""
    settings, zones = BrokerSettings(port=port, data=tmp_path / "store"), "skyless/v1/7/zones"

    def is_written():
        return any(b"kept" in block.read_bytes() for block in settings.data.rglob("$MQTT_rmsgs/msgs/*.blk"))

    broker = await start_broker(settings)
    link = Link(broker.address, "t1", site=7, kind="tag")
    link.publish(zones, b"kept", qos=1, retain=True)
    async with running(link.run()):
        await until(lambda: link.connected and not link.unacknowledged and is_written())
        os.kill(broker.pid, signal.SIGKILL)
    await broker.stop()
    async with await start_broker(settings) as broker:
        assert await kept_messages(broker.address, [zones]) == {zones: b"kept"}


def test_a_taken_port_is_an_error_when_it_was_asked_for(taken, tmp_path, complaint):
    assert f"--port is {taken}, where another program listens" in complaint(
        "broker", "--port", taken, "--data", tmp_path
    )


async def test_without_a_port_the_next_free_one_is_taken(taken, tmp_path, monkeypatch):
    monkeypatch.setattr(broker_module, "FIRST_PORT", taken)

    async with await start_broker(BrokerSettings(data=tmp_path / "store")) as broker:
        assert taken < broker.address.port < taken + 100


async def test_a_broker_that_listens_elsewhere_says_so(taken, tmp_path, monkeypatch, capsys):
    for module in (broker_module, broker_command):
        monkeypatch.setattr(module, "FIRST_PORT", taken)
    serving = asyncio.ensure_future(
        broker_command._serve_once(BrokerSettings(data=tmp_path / "store"), (), None, json=False)
    )
    while not (said := capsys.readouterr()).err:
        assert not serving.done(), serving
        await asyncio.sleep(0.05)
    await stopped(serving)
    assert f"port {taken} is taken" in said.err
    assert f"this one listens at {mqtt_address(said.out.strip()).port};" in said.err


async def test_a_second_broker_of_the_same_user_gets_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))

    async with await start_broker() as first, await start_broker() as second:
        assert first.data == tmp_path / "skyless" / "broker"
        assert second.data != first.data
        assert second.address.port != first.address.port
    assert first.data.exists()
    assert not second.data.exists()


async def test_temporary_data_last_while_the_broker_is_started_again_and_end_with_it(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    broker = await start_broker(BrokerSettings(temporary=True))
    (broker.data / "kept").touch()
    await broker.stop(to_restart=True)
    async with await start_broker(BrokerSettings(data=broker.data)) as again:
        assert (again.data / "kept").exists()
    assert list(tmp_path.iterdir()) == []


async def test_data_of_a_broker_that_was_killed_with_its_owner_are_deleted_by_the_next(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    abandoned = tmp_path / "skyless-broker-dead"
    (abandoned / "jetstream").mkdir(parents=True)
    os.utime(abandoned, (0.0, 0.0))

    async with await start_broker(BrokerSettings(temporary=True)) as first:
        os.utime(first.data, (0.0, 0.0))
        async with await start_broker(BrokerSettings(temporary=True)) as other:
            assert {*tmp_path.iterdir()} == {first.data, other.data}


async def test_a_home_that_cannot_be_written_costs_nothing(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "file"))

    async with await start_broker() as broker:
        assert broker.data.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize(
    ("options", "right"),
    [
        (
            ["--listen", "0.0.0.0"],
            "it should come with --access, or with --user and a password in SKYLESS_MQTT_PASSWORD",
        ),
        (["--user", "ann"], "--user and a password in SKYLESS_MQTT_PASSWORD belong together"),
        (["--listen", "nowhere.invalid", "--user", "ann"], "belong together"),
        (["--certificate", "c.pem"], "--certificate and --key belong together"),
        (["--certificate", "missing.pem", "--key", "missing.pem"], "nats-server does not start: .*missing.pem"),
        (["--data", "/proc/nothing"], "--data is '/proc/nothing', which cannot be used"),
    ],
)
def test_wrong_options_are_reported_with_what_would_be_right(options, right, tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("SKYLESS_MQTT_PASSWORD", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert main(["broker", *options]) == 2
    assert re.search(right, capsys.readouterr().err)


def test_an_address_of_another_machine_is_reported(tmp_path, monkeypatch, complaint):
    monkeypatch.setenv("SKYLESS_MQTT_PASSWORD", "word")
    for listen in ("192.0.2.1", "nowhere.invalid"):
        assert f"--listen is '{listen}'; it should be an address of this machine" in complaint(
            "broker", "--listen", listen, "--user", "ann", "--data", tmp_path
        )


# Its address for programs without ``--mqtt``


FIRST, SECOND = MqttAddress("127.0.0.1", 1891), MqttAddress("127.0.0.1", 1892, user="ann", password="secret")


@pytest.fixture
def own_run_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("SKYLESS_MQTT_PASSWORD", raising=False)


def test_the_last_broker_that_was_started_is_found_until_it_ends(own_run_folder, tmp_path):
    assert running_broker() is None
    first, second = StatedAddress(FIRST), StatedAddress(SECOND)
    os.utime(tmp_path / "skyless" / "broker-1891", (1.0, 1.0))
    assert str(running_broker()) == str(SECOND)
    assert "secret" not in (tmp_path / "skyless" / "broker-1892").read_text()
    second.withdraw()
    assert running_broker() == FIRST
    first.withdraw()
    assert running_broker() is None
    assert list((tmp_path / "skyless").iterdir()) == []


def test_a_broker_whose_program_was_killed_is_not_found(own_run_folder, tmp_path):
    """The system has released the lock; the file is still there."""
    StatedAddress(FIRST).withdraw()
    (tmp_path / "skyless" / "broker-1891").write_text(str(FIRST))
    assert running_broker() is None
    stated = StatedAddress(FIRST)
    assert running_broker() == FIRST
    stated.withdraw()


def test_a_broker_that_starts_while_others_look_for_one_is_found(own_run_folder, tmp_path, monkeypatch):
    """One has the file for a moment; another broker's end removes it just before it is locked."""
    StatedAddress(FIRST).withdraw()
    file = tmp_path / "skyless" / "broker-1891"
    file.touch()
    reader = file.open()
    fcntl.flock(reader, fcntl.LOCK_SH)

    def sleep(_seconds):
        if not reader.closed:
            file.unlink()
            reader.close()

    monkeypatch.setattr(broker_module.time, "sleep", sleep)
    locked = broker_module.locked
    removed = []

    def lock(path):
        found = locked(path)
        if not removed:
            removed.append(path.unlink())
        return found

    monkeypatch.setattr(broker_module, "locked", lock)
    stated = StatedAddress(FIRST)
    assert removed
    assert running_broker() == FIRST
    stated.withdraw()


def test_one_who_looks_removes_no_file_that_a_broker_is_about_to_lock(own_run_folder, tmp_path):
    (tmp_path / "skyless").mkdir(mode=0o700)
    (tmp_path / "skyless" / "broker-1891").touch()
    assert running_broker() is None
    assert (tmp_path / "skyless" / "broker-1891").exists()


@pytest.mark.parametrize("text", [b"", b"\xff\xfe", b"http://127.0.0.1", b"mqtt://"])
def test_a_file_that_states_no_address_is_passed_over(own_run_folder, tmp_path, text):
    stated = StatedAddress(FIRST)
    (tmp_path / "skyless" / "broker-1891").write_bytes(text)
    assert running_broker() is None
    stated.withdraw()


def test_a_folder_that_others_can_write_is_not_used(own_run_folder, tmp_path):
    folder = tmp_path / "skyless"
    folder.mkdir()
    folder.chmod(0o777)
    stated = StatedAddress(FIRST)
    assert running_broker() is None
    stated.withdraw()


def test_a_folder_of_the_user_is_made_where_the_session_has_none(own_run_folder, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    stated = StatedAddress(FIRST)
    assert running_broker() == FIRST
    stated.withdraw()


def test_what_is_given_comes_before_what_is_found_and_that_before_the_usual_one(own_run_folder, capsys):
    assert MqttOptions().address() == MqttAddress("127.0.0.1", 1883)
    stated = StatedAddress(FIRST)
    assert MqttOptions().address() == FIRST
    assert (
        capsys.readouterr().err == "broker mqtt://127.0.0.1:1891, which runs on this machine (--mqtt names another)\n"
    )
    assert MqttOptions(mqtt="mqtt://other:7").address() == MqttAddress("other", 7)
    assert MqttOptions(mqtt="none").address() is None
    assert capsys.readouterr().err == ""
    stated.withdraw()
