"""``skyless site keys`` in a real folder: what it makes, what it refuses, and that it shows no secret."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from skyless.cli.main import main
from skyless.files import replace_files
from skyless.run.keys import read_keys, read_private, read_site_public

pytestmark = pytest.mark.site

SHORT = ("--years", "0.0001")


@pytest.fixture
def site(tmp_path):
    file = tmp_path / "hall.toml"
    size = ["--width", "20", "--depth", "20", "--spacing", "10", "--site-id", "300"]
    assert main(["site", "new", str(file), *size]) == 0
    return str(file)


@pytest.fixture
def keys(site, tmp_path):
    """A folder of keys of the site, with one chain."""
    assert main(["site", "keys", "new", site, *SHORT]) == 0
    return tmp_path / "keys"


def shown(site, capsys):
    capsys.readouterr()
    assert main(["site", "keys", "show", site, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def contents(folder):
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_new_makes_everything_and_overwrites_nothing(site, keys, complaint):
    assert sorted(contents(keys)) == ["chain-1.public", "chain-1.seed", "site.private", "site.public"]
    modes = {file.name: file.stat().st_mode & 0o777 for file in (keys, *keys.iterdir())}
    assert modes["site.private"] == modes["chain-1.seed"] == 0o600
    assert modes["keys"] & 0o077 == 0
    made = read_keys(keys, 300, {})
    assert read_private(keys, made.public)
    (chain,) = made.chains
    now = chain.timing.interval_at(time.time())
    assert chain.holds(now)
    before = contents(keys)
    assert "holds keys already" in complaint("site", "keys", "new", site, *SHORT)
    (keys / "site.private").unlink()
    (keys / "site.public").unlink()
    assert "holds keys already" in complaint("site", "keys", "new", site, *SHORT)
    assert before.items() >= contents(keys).items()


def test_rotate_leaves_no_gap(site, keys, capsys):
    assert main(["site", "keys", "rotate", site, *SHORT, "--starts", later(600.0)]) == 0
    report = shown(site, capsys)
    first, second = report["chains"]
    assert (report["present"], second["serial"], report["least_serial"]) == (1, 2, 1)
    assert time.time() < second["begins_unix_s"] < first["ends_unix_s"]
    assert [chain.serial for chain in read_keys(keys, 300, {}).chains] == [1, 2]


def test_rotate_says_where_there_is_a_gap(site, keys, capsys):
    capsys.readouterr()
    assert main(["site", "keys", "rotate", site, *SHORT]) == 0  # in a day; the first chain lasts an hour
    assert "warning: chain 1 ends" in capsys.readouterr().out


def test_revoke_counts_at_once_and_raises_the_least_serial(site, keys, capsys):
    assert main(["site", "keys", "rotate", site, *SHORT]) == 0
    capsys.readouterr()
    assert main(["site", "keys", "revoke", site, *SHORT]) == 0
    assert "copy chain-3.public and chain-3.seed" in capsys.readouterr().out
    report = shown(site, capsys)
    assert (report["present"], report["least_serial"]) == (3, 3)
    assert [chain["is_revoked"] for chain in report["chains"]] == [True, True, False]
    assert read_site_public(keys / "site.public").least_serial == 3
    assert main(["site", "keys", "rotate", site, *SHORT]) == 0
    assert shown(site, capsys)["chains"][-1]["serial"] == 4


def test_show_shows_no_secret_and_warns_of_the_end(site, keys, capsys):
    report = shown(site, capsys)
    assert report["days_left"] < 60
    assert report["warnings"] == [
        "the last chain ends in 0 days: run skyless site keys rotate, and copy its files to all anchors"
    ]
    assert main(["site", "keys", "show", site]) == 0
    text = capsys.readouterr().out + json.dumps(report)
    secrets = [(keys / "chain-1.seed").read_text().strip(), *(keys / "site.private").read_text().splitlines()[1:2]]
    assert "counts now" in text
    assert not [secret for secret in secrets if secret in text]


def test_new_may_begin_later(site, tmp_path, capsys):
    assert main(["site", "keys", "new", site, *SHORT, "--starts", later(3600.0)]) == 0
    report = shown(site, capsys)
    assert report["present"] is None
    assert "no chain counts at present: beacons carry no codes" in report["warnings"]


@pytest.mark.parametrize(
    ("starts", "words"),
    [
        ("2020-01-01", "which is in the past"),
        ("9000-01-01", "which is in the far future"),
        ("tomorrow", "it should be a date and time"),
        ("0001-01-01T00:00+14:00", "--starts is"),
    ],
)
def test_a_wrong_time_is_refused_before_anything_is_made(site, keys, complaint, starts, words):
    before = contents(keys)
    assert words in complaint("site", "keys", "rotate", site, "--starts", starts)
    assert contents(keys) == before


def test_wrong_input_is_one_line(site, keys, tmp_path, complaint):
    lab = tmp_path / "lab.toml"
    assert main(["site", "new", str(lab), "--paper"]) == 0
    assert 'schedule.mode is "master", whose beacons carry no codes; it should be free' in complaint(
        "site", "keys", "new", lab
    )
    assert "none is no folder" in complaint("site", "keys", "show", site, "--keys", tmp_path / "none")
    assert "is no folder; --keys should name a folder to make" in complaint("site", "keys", "new", site, "--keys", lab)
    assert "missing.toml" in complaint("site", "keys", "new", tmp_path / "missing.toml")
    assert "--years" in complaint("site", "keys", "new", site, "--years", "0")
    other = tmp_path / "other.toml"
    other.write_text((tmp_path / "hall.toml").read_text().replace("id = 300", "id = 301"))
    for command in ("rotate", "revoke", "show"):
        assert "is of site 300; it should be of site 301" in complaint("site", "keys", command, other)
    (keys / "site.private").rename(tmp_path / "elsewhere")
    for command in ("rotate", "revoke"):
        assert "site.private is missing" in complaint("site", "keys", command, site)
    (keys / "chain-1.public").unlink()
    assert "holds no chain-N.public" in complaint("site", "keys", "show", site)


@pytest.mark.statistical
def test_an_interrupt_leaves_nothing(site, tmp_path):
    command = [sys.executable, "-m", "skyless.cli.main", "site", "keys", "new", site, "--years", "10"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)
    time.sleep(2.0)  # wherever it is by then, it is far from its end
    os.killpg(process.pid, signal.SIGINT)
    assert process.wait(60) == 130 or process.returncode == -signal.SIGINT  # before main() began
    assert not (tmp_path / "keys").exists()
    process.stderr.close()


def test_secret_files_are_never_open_to_others(tmp_path, monkeypatch):
    """Not even before they get their contents."""
    seen = []
    write = type(tmp_path).write_bytes
    monkeypatch.setattr(
        type(tmp_path), "write_bytes", lambda file, data: (seen.append(file.stat().st_mode & 0o77), write(file, data))
    )
    replace_files({tmp_path / "seed": b"1"}, secret=(tmp_path / "seed",))
    assert seen == [0]


def later(seconds):
    return time.strftime("%Y-%m-%dT%H:%M:%S", time.localtime(time.time() + seconds))
