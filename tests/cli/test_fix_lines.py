"""``skyless tag --print``, ``--csv`` and ``--json``: its fixes on standard output, into a file, a pipe, a full disk."""

import asyncio
import csv
import io
import re
import signal
import threading
from errno import ENOSPC

import msgspec
import pytest
from node_stage import LAB, PLACE_M, FakeRadio, receptions

from skyless.cli.main import main
from skyless.cli.nodes import tag as command
from skyless.cli.nodes.tag import CSV_COLUMNS, FixLines, csv_row, line_for_people
from skyless.run.mqtt.messages import FixMessage

pytestmark = pytest.mark.site

TAG = ["tag", "one", "--mqtt", "none", "--publish-hz", "1000"]


class Endless(FakeRadio):
    """Receives half a second of the lab as fast as it is processed, and never ends by itself."""

    async def run(self, listener):
        for reception in receptions(0.5):
            listener(msgspec.structs.replace(reception, host_s=None))
        await self.end()

    async def end(self):
        await asyncio.Event().wait()


class PlayedRadio(Endless):
    """Asks the program to end."""

    async def end(self):
        await asyncio.sleep(0.05)
        signal.raise_signal(signal.SIGTERM)
        await super().end()


@pytest.fixture
def played(monkeypatch):
    monkeypatch.setattr(command, "open_radios", lambda *_, **__: [PlayedRadio("one")])


def test_a_csv_table_names_its_units(played, capfd):
    assert main([*TAG, "--csv"]) == 0
    rows = list(csv.DictReader(io.StringIO(capfd.readouterr().out)))
    assert tuple(rows[0]) == CSV_COLUMNS
    last = rows[-1]
    assert (last["tag"], last["alert"]) == ("one", "none")
    assert [float(last[axis]) for axis in ("x_m", "y_m", "z_m")] == pytest.approx(PLACE_M, abs=0.1)
    assert {int(anchor) for anchor in last["anchors"].split()} == {anchor.id for anchor in LAB.anchors}


def test_json_lines_are_the_messages_of_mqtt(played, capfd):
    assert main([*TAG, "--json"]) == 0
    lines = capfd.readouterr().out.splitlines()
    fixes = [msgspec.json.decode(line, type=FixMessage) for line in lines]
    serials = [fix.serial for fix in fixes]
    assert serials == sorted(set(serials))
    assert fixes[-1].position_m == pytest.approx(PLACE_M, abs=0.1)


def test_lines_for_people_have_time_tag_position_and_sigma(played, capfd):
    assert main([*TAG, "--print"]) == 0
    last = capfd.readouterr().out.splitlines()[-1]
    x, y = re.search(r"  one  x ([\d.]+)  y ([\d.]+)  z 0\.000 m \(given\)  ± [\d.]+ cm$", last).groups()
    assert (float(x), float(y)) == pytest.approx(PLACE_M[:2], abs=0.1)


def test_without_an_option_nothing_is_written(played, capfd):
    assert main(TAG) == 0
    assert capfd.readouterr().out == ""


class Gone(io.StringIO):
    def __init__(self, error):
        super().__init__()
        self.error = error

    def write(self, text):
        raise self.error


@pytest.mark.parametrize(("error", "code", "said"), [(BrokenPipeError(), 1, ""), (OSError(ENOSPC, "full"), 2, "full")])
def test_a_reader_that_goes_away_ends_the_program(capfd, monkeypatch, error, code, said):
    monkeypatch.setattr("skyless.cli.nodes.tag._standard_output", lambda: Gone(error))
    monkeypatch.setattr("skyless.cli.main._drop_output", lambda: None)
    monkeypatch.setattr(command, "open_radios", lambda *_, **__: [Endless("one")])
    assert main([*TAG, "--csv"]) == code
    err = capfd.readouterr().err
    assert said in err
    assert "Traceback" not in err


@pytest.mark.parametrize("options", [["--csv", "--json"], ["--print", "--csv", "--json"]])
def test_one_kind_of_lines_at_a_time(complaint, options):
    assert f"{' and '.join(options)} exclude each other" in complaint(*TAG, *options)


async def test_a_reader_that_takes_nothing_delays_no_fix(monkeypatch):
    """Its pipe is full: lines wait, then are dropped and counted; nobody waits for it."""
    taken, free = threading.Event(), threading.Event()

    class Slow(io.StringIO):
        def write(self, text):
            taken.set()
            free.wait(30.0)
            return len(text)

    logged = []
    monkeypatch.setattr("skyless.cli.nodes.tag._standard_output", Slow)
    monkeypatch.setattr("skyless.cli.nodes.tag._CLOSE_S", 0.0)
    lines = FixLines(str, None, logged.append)
    writing = asyncio.ensure_future(lines.run())
    await asyncio.sleep(0)
    for number in range(5000):
        lines.on_fix(number)
    assert await asyncio.to_thread(taken.wait, 30.0)
    writing.cancel()
    await asyncio.gather(writing, return_exceptions=True)
    dropped = lines.dropped
    free.set()
    assert dropped >= 4000
    assert "fixes were not written on standard output: its reader is too slow" in logged[0]


def test_a_fix_without_velocity_and_levels_leaves_its_cells_empty():
    fix = FixMessage(
        tag="a", serial=1, unix_s=1.25, time_s=0.0, position_m=(1.0, 2.0, 3.0), covariance_m2=(0.0,) * 9,
        velocity_mps=None, velocity_covariance=None, std_m=0.01, gdop=None, pdop=None, hdop=None, vdop=None,
        anchors=(1, 2, 3), chi2=0.0, dof=1, residual_rms_m=0.0, method="joint", height_known=False, latency_s=0.001,
        alert="detected-excluded",
    )  # fmt: skip
    row = dict(zip(CSV_COLUMNS, csv_row(fix).split(","), strict=True))
    assert (row["vx_mps"], row["hpl_m"], row["anchors"], row["unix_s"]) == ("", "", "1 2 3", "1.250000")
    assert line_for_people(fix).endswith("z 3.000 m  ± 1.00 cm  detected-excluded")
