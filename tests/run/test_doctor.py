"""``skyless doctor``: each check against something that is well and something that is not."""

import asyncio
import contextlib
import json
import os

import allantools
import numpy as np
import pytest
from live_nodes import LiveSite

from skyless.cli.main import main
from skyless.cli.nodes.doctor import _report
from skyless.core.site import NoiseSite
from skyless.core.ticks import TICK_RATE_HZ
from skyless.radio.serial.serial_port import Pty
from skyless.radio.serial.serial_radio import SerialRadio
from skyless.run import doctor
from skyless.run.doctor import BoardProbe, Check, CounterPairs, assumed_deviation, counters_check
from support.waiting import until

SECOND = round(TICK_RATE_HZ)


# Clocks


def counters(rng, noise, seconds, rate_hz=50.0):
    """TX and RX stamps, wrapped, of two counters that do what the filters assume."""
    steps, dt = int(seconds * rate_hz), 1.0 / rate_hz
    phases_s = []
    for _ in range(2):
        walk = np.cumsum(rng.normal(0.0, noise.random_walk_fm * np.sqrt(dt), steps))
        phases_s.append(np.cumsum(walk * dt + rng.normal(0.0, noise.white_fm * np.sqrt(dt), steps)))
    rx = np.arange(steps) * dt
    tx = rx * (1.0 + 7e-6) + phases_s[0] - phases_s[1] + rng.normal(0.0, noise.tx_stamp_ps * 1e-12, steps)
    rx = rx + rng.normal(0.0, noise.rx_stamp_ps * 1e-12, steps)
    ticks = [np.round((stamps + offset) * TICK_RATE_HZ).astype(np.int64) for stamps, offset in ((tx, 3.0), (rx, 16.0))]
    return [(int(one), int(other)) for one, other in zip(*ticks, strict=True)]


def add(pairs, tx, rx, pair=1):
    pairs.add("r", pair, tx % (1 << 40), rx % (1 << 40), rx / TICK_RATE_HZ)


def pairs_of(rng, noise, seconds, many=12):
    pairs = CounterPairs()
    for pair in range(many):
        for tx, rx in counters(rng, noise, seconds):
            add(pairs, tx, rx, pair)
    return pairs


def test_the_deviation_is_that_of_allantools():
    stamps = counters(np.random.default_rng(1), NoiseSite(), 120.0, rate_hz=10.0)
    pairs = CounterPairs()
    for tx, rx in stamps:
        add(pairs, tx, rx)
    phase_s = np.array([(tx - rx) / TICK_RATE_HZ for tx, rx in stamps])
    for tau_s in (0.5, 4.0):
        (_, (expected,), _, _) = allantools.adev(phase_s, rate=10.0, data_type="phase", taus=[tau_s])
        measured, samples = pairs.deviation(tau_s - 0.005)
        assert measured == pytest.approx(expected, rel=0.02)
        assert samples > 10


def test_counters_as_assumed_are_well_and_those_of_worse_crystals_are_not():
    noise = NoiseSite()
    rng = np.random.default_rng(2)
    well = pairs_of(rng, noise, 60.0)
    for tau_s in (0.5, 4.0):
        assert well.deviation(tau_s)[0] == pytest.approx(assumed_deviation(noise, tau_s), rel=0.15)
    assert counters_check(well, noise, "clocks").result == "ok"
    worse = counters_check(pairs_of(rng, NoiseSite(random_walk_fm=4e-9), 60.0), noise, "clocks")
    assert worse.result == "warning"
    assert "random_walk_fm" in worse.advice
    noisy = counters_check(pairs_of(rng, NoiseSite(tx_stamp_ps=600.0), 60.0), noise, "clocks")
    assert noisy.result == "warning"
    assert "tx_stamp_ps" in noisy.advice
    assert counters_check(pairs_of(rng, noise, 3.0, many=1), noise, "clocks").result == "not checked"


def test_a_counter_that_restarts_begins_again():
    pairs = CounterPairs()
    for start in (0, 12345 * SECOND):
        for step in range(200):
            pairs.add("r", 1, (start + step * SECOND // 10) % (1 << 40), step * SECOND // 10 + start // 7, step / 10.0)
    assert pairs.deviation(0.5)[0] < 1e-12


def test_a_pair_begins_again_after_a_gap_in_which_its_counters_have_turned():
    pairs = CounterPairs()
    for start_s in (0, 40):
        for step in range(100):
            rx = start_s * SECOND + step * SECOND // 10
            add(pairs, rx + rx * 7 // 1_000_000, rx)
    assert pairs.deviation(0.5)[0] < 1e-9


# The computer


def test_ports_that_may_not_be_opened_are_told_with_what_to_type(tmp_path, monkeypatch):
    assert [check.result for check in doctor.port_checks(tmp_path)] == ["not checked"]
    for name in ("ttyACM0", "ttyUSB3", "tty1"):
        (tmp_path / name).touch()
    monkeypatch.setattr(os, "access", lambda path, _: path.name == "ttyUSB3")
    shut, free = doctor.port_checks(tmp_path)
    assert (shut.name, shut.result, free.name, free.result) == ("port ttyACM0", "failed", "port ttyUSB3", "ok")
    assert "sudo usermod -aG " in shut.advice


@pytest.mark.parametrize(("state", "result"), [(0, "ok"), (5, "warning"), (-1, "not checked")])
def test_the_clock_is_as_the_system_says(state, result, monkeypatch):
    assert doctor.clock_check().result in ("ok", "warning", "not checked")

    class System:
        @staticmethod
        def adjtimex(timex):
            timex[24:32] = (2500).to_bytes(8, "little")
            return state

    monkeypatch.setattr(doctor.ctypes, "CDLL", lambda *_, **__: System)
    check = doctor.clock_check()
    assert check.result == result
    assert ("2.5 ms" in check.finding) == (result == "ok")


@pytest.mark.site
def test_a_report_has_what_failed_first_and_nothing_that_controls_a_terminal():
    text = _report([Check("a", "ok", "fine."), Check("b", "failed", "x\n\x1b[2Jy.", "do it")])
    assert text.splitlines()[5:] == ["- failed: b: x��[2Jy.", "  do it", "- ok: a: fine."]
    assert "1 failed, 0 warning, 0 not checked, 1 ok" in text


# Boards


async def examined_board(path, seconds):
    probe = BoardProbe(SerialRadio(str(path), (1_000_000,), path.name), None)
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(probe.run(), seconds)
    return probe.checks(NoiseSite())


@pytest.mark.site
async def test_a_port_that_is_not_there_is_told_and_so_is_a_device_of_another_kind(tmp_path):
    (check,) = await examined_board(tmp_path / "ttyACM7", 0.5)
    assert check.result == "failed"
    assert "There is no " in check.finding
    terminal = Pty(tmp_path / "gps")
    terminal.start(lambda _: None)
    probe = BoardProbe(SerialRadio(str(tmp_path / "gps"), (9600,), "gps"), None)
    listening = asyncio.ensure_future(probe.run())
    async with asyncio.timeout(20.0):
        while "wrong baud rate?" not in probe.checks(NoiseSite())[0].finding:
            terminal.send(b"$GPGGA,1\r\n\0")
            await asyncio.sleep(0.1)
    listening.cancel()
    (check,) = probe.checks(NoiseSite())
    assert check.result == "failed"
    assert "wrong baud rate?" in check.finding


@pytest.mark.live
async def test_a_board_at_a_running_site_is_well(tmp_path):
    async with LiveSite(tmp_path) as site:
        for number in (1, 2, 3, 4, 5, 6):
            site.anchor(number, site.air)
        site.plug_in("tag1")
        probe = BoardProbe(SerialRadio(str(tmp_path / "tag1"), (1_000_000,), "tag1"), None)
        listening = asyncio.ensure_future(probe.run())
        await until(lambda: probe.checks(NoiseSite())[1:2] and probe.checks(NoiseSite())[1].result == "ok", 30.0)
        listening.cancel()
        board, reception, clock = probe.checks(NoiseSite())
    assert (board.result, reception.result) == ("ok", "ok")
    assert "serial link" in board.finding
    assert "6 anchors" in reception.finding
    assert clock.result in ("ok", "warning", "not checked")


# The command


@pytest.mark.site
def test_the_command_writes_a_report_and_its_exit_code_says_whether_anything_failed(
    tmp_path, capsys, complaint, monkeypatch
):
    file = tmp_path / "report.md"
    command = ["doctor", "--mqtt", "none", "--duration", "0.5", "--json", "--report", str(file)]
    code = main(command)
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert code == (1 if found["failed"] else 0)
    assert {check["name"] for check in found["checks"]} >= {"clock"}
    assert file.read_text(encoding="utf-8").startswith("# skyless doctor ")
    assert "--force overwrites it" in complaint(*command)
    missing = ["doctor", "--radio", f"serial:{tmp_path}/ttyACM0", "--mqtt", "none", "--duration", "0.5"]
    assert main(missing) == 1
    assert "There is no " in capsys.readouterr().out


@pytest.mark.site
def test_a_broker_that_is_not_there_fails(capsys):
    command = ["doctor", "--mqtt", "mqtt://127.0.0.1:1", "--site-id", "4", "--duration", "1", "--json"]
    assert main(command) == 1
    found = {one["name"]: one for one in json.loads(capsys.readouterr().out)["checks"]}
    assert found["broker"]["result"] == "failed"
    assert "Connection refused" in found["broker"]["finding"]
