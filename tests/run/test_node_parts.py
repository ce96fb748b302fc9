"""The small parts that the programs of a site share."""

import asyncio
import mmap
import signal
import socket
import sys
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from node_stage import receptions

from skyless.core.errors import SkylessError
from skyless.core.protocol1.beacon import decode
from skyless.run import process as parts
from skyless.run.fix_log import Latencies, PhaseLog
from skyless.run.mqtt.address import MqttAddress
from skyless.run.record import RecorderNode, _client_key, _own_name
from skyless.run.recordings.recorder import McapFile
from support.mqtt_brokers import stopped
from support.processes import started
from support.waiting import running, until

pytestmark = pytest.mark.site

# Latencies and phases


@given(st.lists(st.floats(0.0, 10.0), max_size=300))
def test_latencies_are_reported_once_by_their_order(values):
    latencies = Latencies()
    for value in values:
        latencies.add(value)
    median_s, late_s, number = latencies.drain()
    assert number == len(values)
    if values:
        assert (
            sum(value < median_s for value in values) <= len(values) / 2 <= sum(value <= median_s for value in values)
        )
        assert sum(value > late_s for value in values) <= len(values) / 100
        assert late_s in values
    else:
        assert (median_s, late_s) == (None, None)
    assert latencies.drain() == (None, None, 0)


def test_latencies_keep_the_newest_of_many():
    latencies = Latencies()
    for value in range(10_000):
        latencies.add(float(value))
    median_s, late_s, number = latencies.drain()
    assert number == 4096
    assert median_s == pytest.approx(10_000 - 2048, abs=2)
    assert late_s == pytest.approx(10_000 - 41, abs=2)


def test_the_book_of_phases_shows_the_last_whole_superframe():
    phases = PhaseLog()
    heard = receptions(0.2)
    for number, reception in enumerate(heard):
        phases.add(reception.frame, reception.host_s, reception.host_s + 1e-4, made_fix=number % 2 == 0)
        phases.add(b"rubbish", reception.host_s, reception.host_s, made_fix=False)
    superframes = [decode(reception.frame).superframe for reception in heard]
    last = sorted(set(superframes))[-2]
    inside = [reception for reception, superframe in zip(heard, superframes, strict=True) if superframe == last]
    assert [(phase.superframe, phase.slot) for phase in phases.last] == [
        (last, decode(reception.frame).slot) for reception in inside
    ]
    for phase, reception in zip(phases.last, inside, strict=True):
        assert phase.heard_s == pytest.approx(reception.host_s - inside[0].host_s)
        assert phase.done_s == pytest.approx(phase.heard_s + 1e-4)
    assert {phase.fix for phase in phases.last} == {True, False}


def test_the_phase_log_does_not_grow_while_one_superframe_goes_on_for_ever():
    phases = PhaseLog()
    first, *_ = receptions(0.1)
    for _ in range(1000):
        phases.add(first.frame, 0.0, 0.0, made_fix=False)
    other = next(r for r in receptions(0.2) if decode(r.frame).superframe != decode(first.frame).superframe)
    phases.add(other.frame, 1.0, 1.0, made_fix=False)
    assert len(phases.last) == 64


# Usage


def test_a_busy_process_uses_a_core_and_a_sleeping_one_none():
    """Clocks are read around every question: on a busy machine time may pass between any two lines."""

    def clocks():
        return np.array([time.monotonic(), time.process_time()])

    usage = parts.Usage()
    time.sleep(0.3)
    before = clocks()
    asleep, _ = usage.sample()
    begin = clocks()
    while clocks()[1] < begin[1] + 0.3:
        pass
    end = clocks()
    busy, memory_bytes = usage.sample()
    (longest_s, most_s), (shortest_s, least_s) = clocks() - before, end - begin
    assert asleep < 0.2
    assert least_s / longest_s <= busy <= most_s / shortest_s
    assert memory_bytes == pytest.approx(parts.resident_bytes(), rel=0.05)


def test_memory_that_is_taken_shows():
    before = parts.resident_bytes()
    with mmap.mmap(-1, 50_000_000) as block:  # of its own: what the process has freed before is not used for it
        block[:] = bytes(len(block))
        assert parts.resident_bytes() - before >= 0.9 * len(block)


# Places


def test_recordings_stand_in_the_user_s_data_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert parts.recordings_folder() == tmp_path / "data" / "skyless" / "recordings"
    assert parts.recordings_folder().is_dir()
    monkeypatch.setenv("XDG_DATA_HOME", "not/absolute")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert parts.data_folder() == tmp_path / "home" / ".local" / "share" / "skyless"


@pytest.mark.parametrize("home", ["", "/proc/nowhere", "file"])
def test_a_home_that_cannot_be_written_is_replaced_by_a_temporary_folder(tmp_path, monkeypatch, home):
    (tmp_path / "file").write_text("no folder", encoding="ascii")
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / home) if home == "file" else home)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.chdir(tmp_path)
    folder = parts.recordings_folder()
    assert folder.is_relative_to(tmp_path)
    assert folder.is_dir()
    (folder / "x").write_bytes(b"x")


def test_a_user_without_a_home_and_a_folder_that_is_read_only_are_replaced_too(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "mine"))
    monkeypatch.setattr("os.access", lambda folder, mode: not folder.is_relative_to(tmp_path / "mine"))
    assert parts.data_folder().is_relative_to(tmp_path / "temporary")
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.delenv("HOME")
    monkeypatch.setattr("os.getuid", lambda: 4_000_000_000)
    assert parts.data_folder() == tmp_path / "temporary" / "skyless-4000000000"


def test_a_recorder_passes_over_names_that_others_have(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "skyless-record-1-1.lock").mkdir()  # as a file of another user's, it cannot be opened
    second, lock = _own_name(1)
    third, other = _own_name(1)
    with lock, other:
        assert [second[-2:], third[-2:]] == ["-2", "-3"]
    assert _own_name(1)[0] == second
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nowhere"))
    with pytest.raises(SkylessError, match="no name is left"):
        _own_name(1)


# Ports

HOST = "127.0.0.1"


def any_port(host):
    """A port that is free at this moment."""
    port, held = parts.hold_any(host)
    held.close()
    return port


def test_a_port_that_is_taken_is_passed_over(taken):
    assert not parts.is_free(HOST, taken)
    found, held = parts.reserve_next(HOST, taken)
    with held:
        assert found > taken
    assert any_port(HOST) != taken


def test_a_port_that_was_just_left_is_free():
    with socket.create_server((HOST, 0)) as server:
        port = server.getsockname()[1]
        with socket.create_connection((HOST, port)):
            served, _ = server.accept()
            served.close()  # the server's side closes first and waits in TIME_WAIT
    assert parts.is_free(HOST, port)


def test_two_that_look_at_once_get_two_ports_and_a_reservation_that_ends_frees_its_own():
    port = any_port(HOST)
    first, held = parts.reserve_next(HOST, port)
    second, other = parts.reserve_next(HOST, port)
    assert second > first
    assert parts.reserve(HOST, first) is None
    held.close()
    other.close()
    again = parts.reserve(HOST, first)
    assert again is not None
    again.close()


def test_a_held_port_is_given_to_nobody_but_to_who_asks_for_it():
    port, held = parts.hold_any(HOST)
    with held, socket.create_server((HOST, port)) as server, socket.create_connection((HOST, port)) as caller:
        assert server.accept()[1] == caller.getsockname()


def test_an_address_of_another_machine_is_never_free():
    with pytest.raises(OSError, match="assign"):
        parts.is_free("192.0.2.200", 4711)


# Running together


async def test_parts_stand_and_fall_together():
    ended = []

    async def lasting(name):
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(name)

    async def failing():
        await asyncio.sleep(0.01)
        raise ValueError("broken")

    with pytest.raises(ValueError, match="broken"):
        await parts.together(lasting("a"), failing(), lasting("b"))
    assert sorted(ended) == ["a", "b"]
    task = asyncio.ensure_future(parts.together(lasting("c")))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    await stopped(task)
    assert task.cancelled()
    assert ended[2:] == ["c"]


async def test_something_is_done_again_and_again():
    done = []
    async with running(parts.every(0.01, lambda: done.append(1))):
        await until(lambda: len(done) >= 3)


# The loop of a program

PROGRAM = """
import asyncio, sys
from skyless.run.process import run
async def main():
    try:
        print("running", flush=True)
        await asyncio.sleep(60)
    finally:
        print("cleaned up", flush=True)
try:
    run(main())
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 0), (signal.SIGINT, 130)])
def test_a_program_ends_cleanly_when_it_is_asked_to(number, code):
    with started(sys.executable, "-c", PROGRAM) as process:
        assert process.stdout.readline() == "running\n"
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
    assert (process.returncode, out, err) == (code, "cleaned up\n", "")


def test_a_program_ends_with_the_one_that_started_it_however_that_ends():
    parent = f"""
import subprocess, sys, time
from skyless.run.process import end_with_parent
child = subprocess.Popen([sys.executable, "-c", {PROGRAM!r}], preexec_fn=end_with_parent())
time.sleep(60)
"""
    with started(sys.executable, "-c", parent) as process:
        assert process.stdout.readline() == "running\n"
        process.kill()
        assert process.stdout.read() == "cleaned up\n"  # the pipe ends with the last process that holds it


def test_recorders_of_one_user_have_one_random_key_which_only_the_user_reads(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "mine"))
    key = _client_key()
    file = tmp_path / "mine" / "skyless" / "recorder_key"
    assert (len(key), file.stat().st_mode & 0o777, [*file.parent.iterdir()]) == (32, 0o600, [file])
    assert _client_key() == key
    file.write_text("", encoding="ascii")  # the disk was full
    other = _client_key()
    assert other == _client_key() != key
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "other user"))
    assert _client_key() not in {key, other}


def test_a_stranger_cannot_know_the_name_under_which_a_recorder_s_session_is_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    file = McapFile(tmp_path / "walk.mcap")
    recorder = RecorderNode(file, MqttAddress("127.0.0.1", 1), 7, print)
    client = recorder.link._introduction().client
    recorder._lock.close()
    file.close()
    assert client.endswith(f"-{_client_key()}")
    assert recorder.link._introduction().persistent
