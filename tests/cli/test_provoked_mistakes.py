"""Mistakes that users make: each is answered with one line that names what to correct, and nothing half-written stays.

The commands run in this process, up to where they notice.
"""

import errno
import gzip
import os
import socket
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
        "nan.csv": b"id,x_m,y_m,z_m\n1,nan,0,0\n",
        "truth.csv": synthetic.truth_csv(3.0).encode(),
        "picture": PNG,
        "letter": b"Dear reader,\n",
        "empty": b"",
        "heights.csv": b"id,z_m\n1,high\n",
        "ranges.csv": b"anchor_a,anchor_b,range_m\n1,1,2\n",
    }
    for name, content in files.items():
        Path(name).write_bytes(content)
    synthetic.write(Path("flight.csv"), "tdoa-table", 400)
    packed = gzip.compress(synthetic.truth_csv(100).encode())
    Path("cut.csv.gz").write_bytes(packed[:-400])
    recording = McapFile("nothing.mcap")
    recording.close()
    Path("cut.mcap").write_bytes(Path("nothing.mcap").read_bytes()[:20])
    Path("folder").mkdir()
    return tmp_path


F = ["flight.csv", "--anchors", "anchors.csv"]
MISTAKES = {
    # what is called, and what its line must name
    "a command with a slip": (["simulat"], 'Did you mean "simulate"?'),
    "a command of a group with a slip": (["site", "chekc", "lab.toml"], 'Did you mean "check"?'),
    "an option with a slip": (["simulate", "--noise-p", "100"], "Did you mean --noise-ps?"),
    "no file": (["replay"], "FILE requires an argument"),
    "a word instead of a number": (["simulate", "--tags", "many"], "it should be a whole number"),
    "no number": (["simulate", "--noise-ps", "nan"], "--noise-ps"),
    "a method that is none": (["simulate", "--method", "best"], "it should be one of literal"),
    "a site that is not there": (["site", "check", "none.toml"], "none.toml: it should be a readable site file"),
    "a folder instead of a site": (["site", "check", "folder"], "folder: it should be a readable site file (Is a dir"),
    "a picture instead of a site": (["site", "check", "picture.toml"], "not UTF-8"),
    "a site in another encoding": (["site", "check", "latin.toml"], "a TOML file in UTF-8"),
    "a letter instead of a site": (["site", "check", "letter"], "valid TOML"),
    "a device instead of a site": (["site", "check", "/dev/zero"], "not a pipe or a device"),
    "a key with a slip": (["site", "check", "typo.toml"], "called slot_s"),
    "a master that is no anchor": (["site", "check", "no-master.toml"], "the id of an anchor: 1, 2"),
    "a folder for a site": (["site", "new", "."], "is a folder"),
    "a site that exists": (["site", "new", "lab.toml"], "--force overwrites it"),
    "a room without a depth": (["site", "new", "new.toml", "--width", "3"], "both --width and --depth"),
    "too few anchors to plan": (["plan", "one-anchor.toml"], "at least 3"),
    "a table of another kind": (["plan", "lab.toml", "--grid", "lab.xls"], "--grid is 'lab.xls'; it should end"),
    "a plan that would destroy its site": (["plan", "lab.toml", "--html", "lab.toml"], "writing would destroy it"),
    "a site that is emulated and is not there": (["ether", "--site", "none.toml"], "none.toml"),
    "no table of anchors": (["replay", "flight.csv"], "--anchors is missing"),
    "a table of anchors that is a picture": (["replay", "flight.csv", "--anchors", "picture"], "id,x_m,y_m,z_m"),
    "a table of anchors with a NaN": (["replay", "flight.csv", "--anchors", "nan.csv"], "finite number"),
    "a recording that is a picture": (["replay", "picture", "--anchors", "anchors.csv"], "one of the formats"),
    "an empty recording": (["replay", "empty", "--anchors", "anchors.csv"], "one of the formats"),
    "a recording that is not there": (["replay", "none.mcap"], "none.mcap"),
    "a recording with nothing in it": (["replay", "nothing.mcap"], 'the recording is "empty: no message in it"'),
    "a recording that was cut off": (["replay", "cut.mcap"], "no message in it, and 12 bytes that are not whole"),
    "truth that was cut off": (["replay", *F, "--truth", "cut.csv.gz"], "cut.csv.gz"),
    "truth that is no table": (["replay", *F, "--truth", "letter"], "t_s,x_m,y_m,z_m"),
    "a picture of no kind": (["replay", *F, "--plot", "track.bmp"], ".png, .svg, .pdf"),
    "fixes into a folder that is none": (
        ["replay", *F, "--fixes-csv", "no/fixes.csv"],
        "no/fixes.csv cannot be written",
    ),
    "fixes into a file's folder": (["replay", *F, "--fixes-csv", "letter/fixes.csv"], "letter/fixes.csv cannot be wri"),
    "fixes over the recording": (["replay", *F, "--fixes-csv", "flight.csv"], "writing would destroy it"),
    "an option of another recording": (["replay", *F, "--tag", "a"], "--tag is 'a'; it should be left out"),
    "heights that are words": (["survey", "--recording", "ranges.csv", "--anchor-height", "heights.csv"], ".csv"),
    "a survey of nothing": (["survey"], "a survey needs a recording"),
    "a tag at no point": (["calibrate", *F, "--at", "1"], "--at is '1'"),
    "a study that is none": (["study", "everything"], "NAME is 'everything'; it should be one of efficiency"),
    "a broker that is none": (["record", "--mqtt", "none"], "it should be the broker of the site to record"),
    "a broker's address that is none": (["tag", "one", "--mqtt", "localhost"], "mqtt://HOST[:PORT]"),
    "a radio that is none": (["tag", "one", "--radio", "bluetooth", "--mqtt", "none"], "bluetooth"),
    "a board that is not there": (
        ["tag", "one", "--radio", "sniffer:/dev/none", "--mqtt", "none"],
        "--anchors is miss",
    ),
    "a tag's name": (["tag", "one two", "--mqtt", "none"], "1 to 32 letters"),
    "an anchor that the site has not": (["anchor", "77", "--mqtt", "none"], "IDS is 77"),
    "a recording over another": (["record", "nothing.mcap", "--duration", "1"], "nothing.mcap"),
    "a port that is none": (["broker", "--port", "70000"], "--port"),
    "two ports": (["broker", "--port", "2000", "--listen", "127.0.0.1:2001"], "give the port once"),
    "a broker for all without a password": (["broker", "--listen", "0.0.0.0"], "--user and a password"),
    "a short token": (["dashboard", "--token", "short", "--mqtt", "mqtt://127.0.0.1:1"], "12 or more"),
    "recordings that are no folder": (["dashboard", "--recordings", "letter"], "it should be a folder"),
    "two kinds of lines": (["tag", "one", "--csv", "--json", "--mqtt", "none"], "exclude each other"),
}


def left(folder):
    return {path: path.stat().st_size for path in folder.rglob("*")}


def one_line(capsys, code, said, *, expected=2):
    out, err = capsys.readouterr()
    assert err.startswith("skyless: "), err
    assert said in err
    assert (code, out, err.count("\n")) == (expected, "", 1)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line(room, capsys, mistake):
    arguments, said = MISTAKES[mistake]
    before = left(room)
    one_line(capsys, main(arguments), said)
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
def test_a_full_disk_is_one_line_and_leaves_no_file(room, capsys, full_disk, arguments):
    before = left(room)
    code = main([*arguments, "--json"] if arguments[0] != "site" else arguments)
    _, err = capsys.readouterr()
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith(f"skyless: {arguments[-1]} cannot be ")
    assert "No space left on device" in err
    assert left(room) == before


def test_an_old_table_outlives_a_full_disk(room, capsys, full_disk):
    with Path("out.csv").open("x") as file:  # another mode than that of a table
        file.write("precious")
    assert main(["replay", *F, "--fixes-csv", "out.csv"]) == 2
    assert Path("out.csv").read_text() == "precious"


@pytest.fixture
def taken():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield other.getsockname()[1]


@pytest.mark.parametrize(
    ("arguments", "do"),
    [
        (["broker", "--listen"], "without --port a free one is taken"),
        (["ether", "--site", "lab", "--tags", "1", "--mqtt", "none", "--listen"], "give another port"),
        (["dashboard", "--mqtt", "mqtt://127.0.0.1:1", "--listen"], "without --listen a free one is taken"),
    ],
    ids=lambda one: one[0] if isinstance(one, list) else "",
)
def test_a_port_in_use_is_named_with_what_to_do(room, capsys, taken, arguments, do):
    code = main([*arguments, f"127.0.0.1:{taken}"])
    _, err = capsys.readouterr()
    assert (code, err.count("\n")) == (2, 1)
    assert err.startswith("skyless: ")
    assert str(taken) in err
    assert do in err


def test_no_fix_is_exit_code_1(room, capsys):
    Path("others.csv").write_text("id,x_m,y_m,z_m\n101,0,0,0\n102,5,0,0\n103,5,5,0\n104,0,5,1\n")
    code = main(["replay", "flight.csv", "--anchors", "others.csv", "--json"])
    out, err = capsys.readouterr()
    assert (code, out.count("\n"), err.count("\n")) == (1, 1, 1)
    assert err.startswith("skyless: no fix: no reception is of an anchor in the table")
