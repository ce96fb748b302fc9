"""Programs without ``--mqtt`` find the broker that runs on this machine, and none that has ended."""

import fcntl
import os

import pytest

from skyless.cli.nodes.options import MqttOptions
from skyless.mqtt.address import MqttAddress
from skyless.nodes import broker_address
from skyless.nodes.broker_address import StatedAddress, running_broker

FIRST, SECOND = MqttAddress("127.0.0.1", 1891), MqttAddress("127.0.0.1", 1892, user="ann", password="secret")


@pytest.fixture(autouse=True)
def own_run_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("SKYLESS_MQTT_PASSWORD", raising=False)


def test_the_last_broker_that_was_started_is_found_until_it_ends(tmp_path):
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


def test_a_broker_whose_program_was_killed_is_not_found(tmp_path):
    """The system has released the lock; the file is still there."""
    StatedAddress(FIRST).withdraw()
    (tmp_path / "skyless" / "broker-1891").write_text(str(FIRST))
    assert running_broker() is None
    stated = StatedAddress(FIRST)
    assert running_broker() == FIRST
    stated.withdraw()


def test_a_broker_that_starts_while_others_look_for_one_is_found(tmp_path, monkeypatch):
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

    monkeypatch.setattr(broker_address.time, "sleep", sleep)
    locked = broker_address.locked
    removed = []

    def lock(path):
        found = locked(path)
        if not removed:
            removed.append(path.unlink())
        return found

    monkeypatch.setattr(broker_address, "locked", lock)
    stated = StatedAddress(FIRST)
    assert removed
    assert running_broker() == FIRST
    stated.withdraw()


def test_one_who_looks_removes_no_file_that_a_broker_is_about_to_lock(tmp_path):
    (tmp_path / "skyless").mkdir(mode=0o700)
    (tmp_path / "skyless" / "broker-1891").touch()
    assert running_broker() is None
    assert (tmp_path / "skyless" / "broker-1891").exists()


@pytest.mark.parametrize("text", [b"", b"\xff\xfe", b"http://127.0.0.1", b"mqtt://"])
def test_a_file_that_states_no_address_is_passed_over(tmp_path, text):
    stated = StatedAddress(FIRST)
    (tmp_path / "skyless" / "broker-1891").write_bytes(text)
    assert running_broker() is None
    stated.withdraw()


def test_a_folder_that_others_can_write_is_not_used(tmp_path):
    folder = tmp_path / "skyless"
    folder.mkdir()
    folder.chmod(0o777)
    stated = StatedAddress(FIRST)
    assert running_broker() is None
    stated.withdraw()


def test_a_folder_of_the_user_is_made_where_the_session_has_none(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    stated = StatedAddress(FIRST)
    assert running_broker() == FIRST
    stated.withdraw()


def test_what_is_given_comes_before_what_is_found_and_that_before_the_usual_one(capsys):
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
