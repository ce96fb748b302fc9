"""The program as its user meets it: in a process of its own."""

import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from skyless.core.site import AccuracySite
from skyless.sim.lab import paper_lab_site
from skyless.site.file.template import site_template
from support.waiting import came

pytestmark = pytest.mark.site

SKYLESS = [sys.executable, "-m", "skyless.cli.main"]


def skyless(*arguments, **options):
    return subprocess.run([*SKYLESS, *map(str, arguments)], capture_output=True, text=True, check=False, **options)


@pytest.fixture
def lab(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text(site_template(paper_lab_site(accuracy=AccuracySite())), encoding="utf-8")
    return path


def test_help_imports_nothing_heavy():
    code = (
        "import sys\nfrom skyless.cli.main import main\n"
        "try: main(['--help'])\nfinally: print(*sorted(sys.modules), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stderr.split())
    assert "cyclopts" in loaded
    assert loaded.isdisjoint({"numpy", "scipy", "matplotlib", "yaml", "msgspec"})
    assert "Usage: skyless COMMAND" in done.stdout


def test_the_commands_stand_in_groups_of_what_they_are_for():
    for arguments in ((), ("--help",)):
        done = skyless(*arguments)
        groups = ("Start here", "Set up and check a site", "Run a site", "Record and replay", "Emulate", "Research")
        found = [done.stdout.index(f"─ {name}") for name in (*groups, "Options")]
        assert (done.returncode, done.stderr) == (0, "")
        assert found == sorted(found)
        assert done.stdout.index("│ demo") < found[1]
        assert "Example: skyless demo" in done.stdout


def test_version():
    done = skyless("--version")
    assert (done.returncode, done.stdout.strip()) == (0, version("skyless"))


@pytest.mark.statistical
def test_every_command_has_help_with_an_example():
    for command in (["demo"], ["simulate"], ["replay"], ["site"], ["site", "new"], ["site", "check"]):
        done = skyless(*command, "--help")
        assert done.returncode == 0
        assert f"Example: skyless {' '.join(command)}" in done.stdout
        assert done.stdout.count("--no-") == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["sit"], 'Did you mean "site"?'),
        (["sit"], "Available commands: demo, simulate, site, "),
        (["compare"], 'Did you mean skyless benchmark ("Compare methods'),
        (["site", "check", "--jso"], "Did you mean --json?"),
        (["site", "check"], "requires an argument"),
        (["site", "new", "x.toml", "--width", "wide", "--depth", "3"], "--width"),
    ],
)
def test_a_slip_is_told_on_standard_error(arguments, said):
    done = skyless(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("skyless: ")
    assert done.stderr.count("\n") == 1
    assert said in done.stderr


def test_a_site_file_is_a_file(tmp_path, complaint):
    """What never ends, or waits for a writer, is refused at once."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path in (pipe, "/dev/zero"):
        assert "a site file, not a pipe or a device" in complaint("site", "check", path)


@pytest.mark.statistical
def test_a_reader_that_goes_away(lab):
    for arguments in (["site", "check", lab], ["site", "check", lab, "--json"], ["--help"]):
        reader, writer = os.pipe()
        os.close(reader)
        done = subprocess.run([*SKYLESS, *map(str, arguments)], stdout=writer, stderr=subprocess.PIPE, check=False)
        os.close(writer)
        assert (done.returncode, done.stderr) == (1, b"")


@pytest.mark.statistical
def test_a_full_disk_behind_standard_output(lab):
    for arguments in (["site", "check", lab], ["site", "check", lab, "--json"], ["--help"]):
        with Path("/dev/full").open("wb") as full:
            done = subprocess.run([*SKYLESS, *map(str, arguments)], stdout=full, stderr=subprocess.PIPE, check=False)
        assert (done.returncode, done.stderr.count(b"\n")) == (2, 1)
        assert done.stderr.startswith(b"skyless: standard output cannot be written: No space left")


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
@pytest.mark.statistical
def test_closed_streams(lab, closed):
    done = subprocess.run(["sh", "-c", f'"$@" {closed}', "sh", *SKYLESS, "site", "check", str(lab)], check=False)
    assert done.returncode == 0


def test_a_terminal_without_unicode(lab):
    done = skyless("site", "check", lab, env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert done.returncode == 0
    assert "315 \\xb5s" in done.stdout


@pytest.mark.statistical
def test_sigterm_ends_a_command_with_all_its_processes(tmp_path):
    arguments, worker = ["paper", "--quick", "--out", "report"], "multiprocessing.spawn"
    options = {"env": dict(os.environ), "cwd": tmp_path, "stderr": subprocess.PIPE, "start_new_session": True}
    default = ["env", "--default-signal=INT"]  # what a shell starts in the background ignores it
    process = subprocess.Popen([*default, *SKYLESS, *arguments], **options)
    workers = came(lambda: [pid for pid in children(process.pid) if worker in words_of(pid)], 120.0)
    process.terminate()
    _, told = process.communicate(timeout=60)
    assert process.returncode == 143
    assert b"Traceback" not in told
    came(lambda: not any(worker in words_of(pid) for pid in workers))
    assert not (tmp_path / "report").exists()


def children(pid):
    return Path(f"/proc/{pid}/task/{pid}/children").read_text().split()


def words_of(pid):
    try:
        return Path(f"/proc/{pid}/cmdline").read_text()
    except OSError:
        return ""


DROPPED_BY_AN_IMPORT = """
try:
    os.kill(os.getpid(), signal.SIGINT)
    list(range(9))
except KeyboardInterrupt:
    pass
"""
DROPPED_BY_CTYPES = """
class Number:
    @classmethod
    def from_param(cls, number):
        os.kill(os.getpid(), signal.SIGINT)
        list(range(9))
        return number

import ctypes
function = ctypes.CDLL(None).abs
function.argtypes = [Number]
sys.modules["__main__"].function = function
"""


@pytest.mark.parametrize("dropping", [DROPPED_BY_AN_IMPORT, DROPPED_BY_CTYPES])
def test_an_interrupt_that_would_be_dropped_is_not_lost(dropping, tmp_path):
    """As NumPy's modules drop it, callbacks of Python's import system, and arguments of ctypes."""
    (tmp_path / "dropping.py").write_text("import os, signal, sys\n" + dropping)
    code = (
        "import sys, time\nfrom skyless.cli import main\nfunction = abs\n"
        "def command(_):\n    import dropping\n    function(1)\n    print('done', flush=True)\n    time.sleep(60)\n"
        "main.program = lambda: command\nsys.exit(main.main())"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join((str(tmp_path), *sys.path))}
    words = ["env", "--default-signal=INT", sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment, timeout=50)
    assert (done.returncode, done.stderr) == (130, "")


def test_json_is_the_last_line(lab):
    done = skyless("site", "check", lab, "--json")
    report = json.loads(done.stdout.splitlines()[-1])
    assert (done.returncode, done.stderr, done.stdout.count("\n")) == (0, "", 1)
    assert report["beacons_per_s_of_each_anchor"] == pytest.approx(1 / 0.015, rel=1e-5)
    assert report["messages_per_s"] == pytest.approx(400, rel=1e-5)
    assert report["longest_frame_s"] == pytest.approx(315e-6, abs=0.5e-6)  # docs/radio.md
    assert report["occupancy"] == pytest.approx(0.315 / 2.5, rel=1e-3)
    assert [anchor["slots"] for anchor in report["anchors"]] == [[0], [1], [2], [3], [4], [5]]
    assert report["warnings"] == []


def test_main_returns_the_exit_code(complaint, tmp_path):
    assert "none.toml" in complaint("site", "check", tmp_path / "none.toml")
