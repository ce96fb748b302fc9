"""The table of SECURITY.md of what listens where: programs that are started without options, and their sockets."""

import contextlib
import re
import stat
import time
from pathlib import Path

import httpx2 as httpx
import psutil
import pytest

from support.processes import SKYLESS, started

pytestmark = pytest.mark.site

ROOT = Path(__file__).parents[2]
TABLE = (ROOT / "SECURITY.md").read_text(encoding="utf-8").partition("### What listens where")[2]


def addresses(process):
    """Where a process and its children listen, by the names of the programs."""
    found = set()
    for one in (process, *process.children(recursive=True)):
        with contextlib.suppress(psutil.Error):
            found |= {link.laddr.ip for link in one.net_connections("inet") if not link.raddr and link.laddr}
    return found


@pytest.mark.parametrize("program", ["broker", "dashboard", "demo"])
def test_without_options_nothing_listens_but_for_this_computer(program, tmp_path, monkeypatch):
    (row,) = re.findall(rf"^\| `skyless {program}` \| (.*?) \| (.*?) \|", TABLE, re.MULTILINE)
    assert row[1] == "reaches nothing"
    for name in ("HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    words = ("--mqtt", "mqtt://127.0.0.1:9") if program == "dashboard" else ()
    with started(*SKYLESS, program, *words, limit_s=180.0) as process:
        assert process.stdout.readline()
        seen, begun_s = set(), time.monotonic()
        while time.monotonic() < begun_s + 2.0:
            seen |= addresses(psutil.Process(process.pid))
            time.sleep(0.2)
    assert seen == {*re.findall(r"\d+\.\d+\.\d+\.\d+", row[0])} == {"127.0.0.1"}
    private = [file for file in tmp_path.rglob("*") if file.name in {"nats-server.conf", "broker"}]
    assert all(file.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO) == 0 for file in private)
    assert bool(private) == (program == "broker"), "a demo's broker has a temporary folder"


def test_a_page_for_others_asks_for_the_token():
    with started(*SKYLESS, "dashboard", "--mqtt", "mqtt://127.0.0.1:9", "--listen", "0.0.0.0:0") as process:
        page = re.search(r"http\S*", process.stdout.readline())[0]
        port = re.search(r":(\d+)/", page)[1]
        assert "token=" in page
        assert httpx.get(f"http://127.0.0.1:{port}/api/v1/site").status_code == 401
