"""``scripts/audit``: every locked version is asked for, findings and failures have their own exit codes."""

import json
import os
import shutil
import subprocess
import threading
import tomllib
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

pytestmark = pytest.mark.site

ROOT = Path(__file__).parents[2]
ADVISORY = "GHSA-test-test-test"


@pytest.fixture(scope="module")
def uv():
    """A uv that has the command; nothing is installed for this test."""
    for found in (shutil.which("uv"), ROOT / ".venv-uv" / "uv"):
        if found and Path(found).exists():
            if subprocess.run([found, "audit", "--help"], capture_output=True, check=False).returncode:
                pytest.skip("this uv has no audit")
            return Path(found)
    pytest.skip("uv is not installed")


class Database(HTTPServer):
    """Two of the requests of OSV's interface, version 1: queries in a batch, and one advisory."""

    def __init__(self, faulty=(), status=200):
        super().__init__(("127.0.0.1", 0), Answers)
        self.faulty, self.status, self.asked = faulty, status, set()
        self.url = f"http://127.0.0.1:{self.server_port}"

    def __enter__(self):
        threading.Thread(target=self.serve_forever, daemon=True).start()
        return self

    def __exit__(self, *_):
        self.shutdown()
        self.server_close()

    def answer(self, queries):
        results = []
        for query in queries:
            self.asked.add((query["package"]["name"], query["version"]))
            found = [{"id": ADVISORY, "modified": "2026-01-01T00:00:00Z"}]
            results.append({"vulns": found} if query["package"]["name"] in self.faulty else {})
        return {"results": results}

    def advisory(self):
        events = [{"introduced": "0"}, {"fixed": "9999"}]
        ranges = [{"type": "ECOSYSTEM", "events": events}]
        affected = [{"package": {"name": name, "ecosystem": "PyPI"}, "ranges": ranges} for name in self.faulty]
        return {"id": ADVISORY, "modified": "2026-01-01T00:00:00Z", "summary": "for a test", "affected": affected}


class Answers(BaseHTTPRequestHandler):
    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.send(self.server.answer(json.loads(body)["queries"]))

    def do_GET(self):
        self.send(self.server.advisory())

    def send(self, answer):
        body = json.dumps(answer).encode()
        self.send_response(self.server.status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@pytest.fixture
def audit(uv, tmp_path):
    """A function that runs the script against a database."""

    def run(url):
        environment = os.environ | {
            "PATH": f"{uv.parent}:{os.environ['PATH']}",
            "UV_CACHE_DIR": str(tmp_path / "cache"),
            "UV_HTTP_RETRIES": "0",
            "NO_PROXY": "127.0.0.1",
        }
        command = [ROOT / "scripts" / "audit", "--service-url", url]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=120)
        return done.returncode, done.stdout + done.stderr

    return run


def test_every_locked_version_is_asked_for(audit):
    locked = tomllib.loads((ROOT / "uv.lock").read_text(encoding="utf-8"))["package"]
    with Database() as database:
        code, _ = audit(database.url)
    assert code == 0
    expected = {(one["name"], one["version"]) for one in locked if one["name"] != "skyless"}
    assert database.asked == expected


@pytest.mark.parametrize("name", ["numpy", "pytest"])
def test_a_vulnerability_is_an_error_that_names_its_package(audit, name):
    """Of what users run, and of what only developers do."""
    with Database(faulty={name}) as database:
        code, said = audit(database.url)
    assert code == 1
    assert name in said
    assert ADVISORY in said


def test_without_a_network_it_is_skipped_in_one_clear_line(audit):
    code, said = audit("http://127.0.0.1:1")
    assert code == 0
    assert "skyless: skipped: no network to the advisory database (tcp connect error)" in said


@pytest.mark.parametrize("status", [404, 500, 503])
def test_a_database_that_fails_is_no_missing_network(audit, status):
    with Database(status=status) as database:
        code, said = audit(database.url)
    assert code == 2
    assert str(status) in said
    assert "skipped" not in said
