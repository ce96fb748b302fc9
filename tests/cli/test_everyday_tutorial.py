"""The tutorial of a site's everyday, line by line against a real demo: names, zones, a rule, an alarm, the history."""

import csv
import json
import re
import shlex
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from urllib.request import Request, urlopen

import pytest

from support.waiting import came

pytest.importorskip("duckdb")

TEXT = Path(__file__).parents[2].joinpath("docs", "tutorials", "everyday.md").read_text(encoding="utf-8")
PROGRAM = f"{shlex.quote(sys.executable)} -m skyless.cli.main "
FILES = re.findall(r"as `(\w+\.\w+)`.*?^```text\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)
BLOCKS = re.findall(r"^```sh\n(.*?)^```", TEXT, re.DOTALL | re.MULTILINE)
LINES = [line for block in BLOCKS for line in block.splitlines()]


def run(line, folder):
    """Run a line of the tutorial, and return what it prints."""
    done = subprocess.run(
        ["bash", "-ec", re.sub(r"^skyless ", PROGRAM, line)], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.live
def test_every_line_of_the_tutorial_runs(tmp_path):
    for name, text in FILES:
        (tmp_path / name).write_text(text, encoding="utf-8")
    made, demo, *others = LINES
    run(made, tmp_path)
    words = [sys.executable, "-m", "skyless.cli.main", *shlex.split(demo)[1:]]
    running = subprocess.Popen(words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        page = next(line.split()[1] for line in running.stdout if line.startswith("page "))

        def get(path):
            with urlopen(f"{page}/api/v1/{path}") as answer:
                return json.load(answer)

        def ready():
            try:
                is_kept = any(event["text"].startswith("history ") for event in get("events")["events"])
                return is_kept and get("site")["connected"] and len(get("fixes")["fixes"]) == 3
            except OSError:
                return False

        came(ready)
        while not others[0].startswith("skyless history"):
            line = others.pop(0).replace("http://127.0.0.1:8080", page)
            if "/alarms" in line:
                came(lambda: get("alarms")["alarms"])
            printed = run(line, tmp_path)
            assert not printed.startswith('{"error"')
        assert "Forklift 1" in printed  # the text view, the last of them
        assert {tag["tag"]: tag["name"] for tag in get("tags")["tags"]}["tag3"] == "Ada"
        (alarm,) = get("alarms")["alarms"]
        assert {"Forklift 1", "Forklift 2"} <= set(re.findall(r"Forklift \d", alarm["sentence"]))
        came(lambda: get("events")["events"])
        path = f"{page}/api/v1/alarms/{alarm['rule']}/{alarm['subject']}/acknowledge"
        body = json.dumps({"id": alarm["id"], "by": "Ada"}).encode()
        urlopen(Request(path, body, {"content-type": "application/json"}, method="POST")).close()
        kept = tmp_path / "history"
        came(lambda: any(b"Ada" in file.read_bytes() for file in kept.rglob("EVENTS_*/msgs/*.blk")))
    finally:
        running.send_signal(signal.SIGINT)
        said, _ = running.communicate()
    assert "started again" not in said
    answers = {}
    for line in others:
        (answer,) = run(f'{line} --from "1 hour ago" --json', tmp_path).splitlines()[-1:]
        answers |= json.loads(answer)
    rows = list(csv.DictReader((tmp_path / "fixes.csv").open(encoding="utf-8")))
    fixes_of = Counter(row["tag"] for row in rows)
    assert set(fixes_of) == {"tag1", "tag2", "tag3"}
    assert answers["track"]["fixes"] == fixes_of["tag1"]
    assert {row["zone_name"] for row in answers["dwell"]} <= {"Goods in", "Store"}
    assert sum(row["seconds"] for row in answers["dwell"]) > 0.0
    assert [row["text"] for row in answers["sql"] if row["kind"] == "alarm-acknowledged"] == ["Ada"]
    assert {file.name for file in tmp_path.glob("*.png")} == {"way.png", "heat.png"}
