"""Mistakes that users make: each is answered with one line that names what to correct, and nothing half-written stays.

The commands run in this process, up to where they notice.
"""

import errno
import os
from pathlib import Path

import pytest

from skyless.cli.main import main
from skyless.run.recordings.recorder import McapFile
from skyless.sim.lab import lab_site, paper_lab_site
from skyless.site.file.template import site_template
from support import synthetic_recordings as synthetic

pytestmark = pytest.mark.site

PNG = b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 8


@pytest.fixture
def room(tmp_path, monkeypatch):
    """A folder with good files and bad ones, where the commands run."""
    monkeypatch.chdir(tmp_path)
    lab, paper = site_template(lab_site()), site_template(paper_lab_site())
    files = {
        "lab.toml": lab.encode(),
        "picture.toml": PNG,
        "latin.toml": b'name = "S\xfcd"\n',
        "no-master.toml": paper.replace("\nmaster = 1", "\nmaster = 77").encode(),
        "typo.toml": paper.replace("slot_s =", "slots_s =").encode(),
        "one-anchor.toml": lab.split("[[anchors]]", 2)[0].encode() + b"[[anchors]]\nid = 1\nx_m = 0.0\ny_m = 0.0\n",
        "anchors.csv": synthetic.anchors_csv().encode(),
        "picture": PNG,
        "letter": b"Dear reader,\n",
        "heights.csv": b"id,z_m\n1,high\n",
        "ranges.csv": b"anchor_a,anchor_b,range_m\n1,1,2\n",
    }
    for name, content in files.items():
        Path(name).write_bytes(content)
    synthetic.write(Path("flight.csv"), "tdoa-table", 400)
    McapFile("nothing.mcap").close()
    Path("cut.mcap").write_bytes(Path("nothing.mcap").read_bytes()[:20])
    Path("folder").mkdir()
    return tmp_path


F = ["flight.csv", "--anchors", "anchors.csv"]
MISTAKES = {
    # what is called, and what its line must name; tests of the commands have more
    "a command of a group with a slip": (["site", "chekc", "lab.toml"], 'Did you mean "check"?'),
    "a word instead of a number": (["simulate", "--tags", "many"], "it should be a whole number"),
    "a site that is not there": (["site", "check", "none.toml"], "none.toml: it should be a readable site file"),
    "a folder instead of a site": (["site", "check", "folder"], "folder: it should be a readable site file (Is a dir"),
    "a picture instead of a site": (["site", "check", "picture.toml"], "not UTF-8"),
    "a site in another encoding": (["site", "check", "latin.toml"], "a TOML file in UTF-8"),
    "a letter instead of a site": (["site", "check", "letter"], "valid TOML"),
    "a key with a slip": (["site", "check", "typo.toml"], "called slot_s"),
    "a master that is no anchor": (["site", "check", "no-master.toml"], "the id of an anchor: 1, 2"),
    "a folder for a site": (["site", "new", "."], "is a folder"),
    "too few anchors to plan": (["plan", "one-anchor.toml"], "at least 3"),
    "a table of another kind": (["plan", "lab.toml", "--grid", "lab.xls"], "--grid is 'lab.xls'; it should end"),
    "a plan that would destroy its site": (["plan", "lab.toml", "--html", "lab.toml"], "writing would destroy it"),
    "a site that is emulated and is not there": (["ether", "--site", "none.toml"], "none.toml"),
    "a recording with nothing in it": (["replay", "nothing.mcap"], 'the recording is "empty: no message in it"'),
    "a recording that was cut off": (["replay", "cut.mcap"], "no message in it, and 12 bytes that are not whole"),
    "fixes into a file's folder": (["replay", *F, "--fixes-csv", "letter/fixes.csv"], "letter/fixes.csv cannot be wri"),
    "an option of another recording": (["replay", *F, "--tag", "a"], "--tag is 'a'; it should be left out"),
    "heights that are words": (["survey", "--recording", "ranges.csv", "--anchor-height", "heights.csv"], ".csv"),
    "a broker's address that is none": (["tag", "one", "--mqtt", "localhost"], "mqtt://HOST[:PORT]"),
    "a radio that is none": (["tag", "one", "--radio", "bluetooth", "--mqtt", "none"], "bluetooth"),
    "a tag's name": (["tag", "one two", "--mqtt", "none"], "1 to 32 letters"),
    "an anchor that the site has not": (["anchor", "77", "--mqtt", "none"], "IDS is 77"),
    "a recording over another": (["record", "nothing.mcap", "--duration", "1"], "nothing.mcap"),
    "a port that is none": (["broker", "--port", "70000"], "--port"),
    "two ports": (["broker", "--port", "2000", "--listen", "127.0.0.1:2001"], "give the port once"),
}


def left(folder):
    return {path: path.stat().st_size for path in folder.rglob("*")}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line(room, complaint, mistake):
    arguments, said = MISTAKES[mistake]
    before = left(room)
    assert said in complaint(*arguments)
    assert left(room) == before


@pytest.fixture
def full_disk(monkeypatch):
    """Files can be made, and hold nothing."""
    plain_open, write_bytes = Path.open, Path.write_bytes

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def open_full(path, mode="r", *arguments, **options):
        file = plain_open(path, mode, *arguments, **options)
        return _Full(file, full) if mode == "w" else file

    def write_full(path, data):
        write_bytes(path, data[:1])
        full()

    monkeypatch.setattr(Path, "open", open_full)
    monkeypatch.setattr(Path, "write_bytes", write_full)


class _Full:
    """A file of a full disk."""

    def __init__(self, file, full):
        self._file, self.write, self.writelines = file, full, full

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._file.close()


@pytest.mark.parametrize(
    "arguments",
    [
        ["simulate", "--duration", "3", "--fixes-csv", "out.csv"],
        ["replay", *F, "--fixes-csv", "out.csv"],
        ["replay", *F, "--plot", "out.png"],
        ["site", "new", "out.toml"],
        ["plan", "lab.toml", "--step", "2", "--grid", "out.csv"],
        ["plan", "lab.toml", "--step", "2", "--plot", "out.png"],
    ],
    ids=lambda arguments: f"{arguments[0]} {arguments[-2]}",
)
def test_a_full_disk_is_one_line_and_leaves_no_file(room, complaint, full_disk, arguments):
    before = left(room)
    err = complaint(*arguments, *(["--json"] if arguments[0] != "site" else []))
    assert err.startswith(f"skyless: {arguments[-1]} cannot be ")
    assert "No space left on device" in err
    assert left(room) == before


def test_an_old_table_outlives_a_full_disk(room, capsys, full_disk):
    with Path("out.csv").open("x") as file:  # another mode than that of a table
        file.write("precious")
    assert main(["replay", *F, "--fixes-csv", "out.csv"]) == 2
    assert Path("out.csv").read_text() == "precious"


@pytest.mark.parametrize(
    ("arguments", "do"),
    [
        (["broker", "--listen"], "without --port a free one is taken"),
        (["ether", "--site", "lab", "--tags", "1", "--mqtt", "none", "--listen"], "give another port"),
        (["dashboard", "--mqtt", "mqtt://127.0.0.1:1", "--listen"], "without --listen a free one is taken"),
    ],
    ids=lambda one: one[0] if isinstance(one, list) else "",
)
def test_a_port_in_use_is_named_with_what_to_do(room, complaint, taken, arguments, do):
    err = complaint(*arguments, f"127.0.0.1:{taken}")
    assert str(taken) in err
    assert do in err
