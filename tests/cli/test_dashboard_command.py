"""``skyless dashboard``: its options, and its port."""

import json
import os
import signal
import socket
import subprocess
import sys
from urllib.parse import urlsplit

import pytest

from skyless.cli.dashboard import DashboardOptions, _address, _rules
from skyless.cli.main import main
from skyless.cli.nodes.options import listen_address
from skyless.core.errors import SkylessError
from skyless.page.app import PORT, bind
from skyless.run.process import reserve
from skyless.sim.lab import lab_site
from support.processes import free_port

pytestmark = pytest.mark.site


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        (DashboardOptions().listen, "127.0.0.1", None),
        ("127.0.0.1:9000", "127.0.0.1", 9000),
        ("[::1]:9000", "::1", 9000),
        ("::1", "::1", None),
        ("[::1]", "::1", None),
        ("hall.example", "hall.example", None),
        ("localhost:0", "localhost", 0),
        ("9000", "127.0.0.1", 9000),
    ],
)
def test_where_to_listen(text, host, port):
    assert listen_address(text, PORT) == (host, port)


@pytest.mark.parametrize("text", ["", ":8080", "127.0.0.1:x", "127.0.0.1:70000", "127.0.0.1:-1", "localhost:8080x"])
def test_a_wrong_listening_is_refused_with_what_would_be_right(text):
    with pytest.raises(SkylessError, match="HOST:PORT"):
        listen_address(text, PORT)


def test_a_taken_port_is_an_error_when_it_was_asked_for(taken):
    with pytest.raises(SkylessError, match=f"--listen is '127.0.0.1:{taken}'; another program uses this port"):
        bind("127.0.0.1", taken)


def test_the_next_free_port_is_taken_when_none_was_asked_for():
    with bind("127.0.0.1", None) as first, bind("127.0.0.1", None) as second:
        assert PORT <= first.getsockname()[1] < second.getsockname()[1]


def test_a_port_that_a_demo_has_named_is_left_to_its_page():
    with bind("127.0.0.1", None) as first:
        port = first.getsockname()[1]
        claimed = reserve("127.0.0.1", port)
    assert claimed is not None
    with claimed, bind("127.0.0.1", None) as second:
        assert second.getsockname()[1] != port
        with bind("127.0.0.1", port) as page:
            assert page.getsockname()[1] == port


def test_an_address_of_another_machine_is_refused():
    with pytest.raises(SkylessError, match="cannot listen"):
        bind("192.0.2.1", 8080)
    with pytest.raises(SkylessError, match="cannot listen"):
        bind("no such host", 8080)


def test_loopback_needs_no_token_and_all_else_gets_one():
    assert _rules("127.0.0.1", "127.0.0.1", 1, None).token is None
    assert _rules("::1", "::1", 1, None).token is None
    assert _rules("127.0.0.1", "127.0.0.1", 1, "a-token-of-my-own").token == "a-token-of-my-own"
    first, second = (_rules("0.0.0.0", "0.0.0.0", 1, None) for _ in range(2))
    assert first.remote
    assert first.token
    assert first.token != second.token
    assert _rules("0.0.0.0", "0.0.0.0", 1, "a-token-of-my-own").token == "a-token-of-my-own"


def test_a_readers_token_makes_an_operators():
    for bound in ("127.0.0.1", "0.0.0.0"):
        rules = _rules(bound, bound, 1, None, "readers-token-1")
        assert rules.token
        assert (rules.reader_token, rules.token == rules.reader_token) == ("readers-token-1", False)
    assert _rules("::1", "::1", 1, "a-token-of-my-own", "readers-token-1").token == "a-token-of-my-own"


def test_the_address_that_is_printed_is_one_that_others_can_open():
    rules = _rules("0.0.0.0", "0.0.0.0", 8080, "with/slash&and=more")
    address = _address("0.0.0.0", 8080, rules)
    assert "0.0.0.0" not in address
    assert address.endswith(":8080/?token=with%2Fslash%26and%3Dmore")
    assert _address("::1", 8080, _rules("::1", "::1", 8080, None)) == "http://[::1]:8080/"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--token", "short"], "--token has 5 characters"),
        (["--reader-token", "short"], "--reader-token has 5 characters"),
        (["--token", "one-and-the-same", "--reader-token", "one-and-the-same"], "--reader-token is the same as --tok"),
        (["--history", "/no/such/folder"], "--history is '/no/such/folder'; it should be a folder"),
        (["--assets", "/no/such/folder/a.csv"], "--assets is '/no/such/folder/a.csv'"),
        (["--mqtt", "http://x"], "--mqtt is"),
        (["--recordings", "/no/such/folder"], "--recordings is '/no/such/folder'; it should be a folder"),
        (["--site", "/no/such/site.toml"], "site.toml"),
        (["--listen", "nonsense:port"], "--listen is"),
        (["--site-id", "70000"], "70000"),
    ],
)
def test_wrong_options_end_with_2_and_one_line(complaint, arguments, expected):
    assert expected in complaint("dashboard", *arguments)


def test_the_site_file_and_the_number_must_agree(complaint, tmp_path):
    assert main(["site", "new", str(tmp_path / "site.toml")]) == 0
    assert "give one of them" in complaint("dashboard", "--site", tmp_path / "site.toml", "--site-id", "4711")


def test_the_server_loads_nothing_heavy():
    """Overlays have a process of their own; NumPy in this one would cost its start time and memory."""
    look = "import skyless.page.app, skyless.page.playback, sys; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", look], capture_output=True, text=True, check=True).stdout.split()
    assert "skyless.page.app" in loaded
    assert not {"numpy", "scipy", "matplotlib"} & set(loaded)


BUSY = """
import sys
from skyless.cli.main import main
from skyless.cli.nodes.options import listen_address
from skyless.page.api import questions
from skyless.page.tasks import TaskProcess

questions.TaskProcess = lambda module, fault: TaskProcess("never_answers", fault)
sys.exit(main(sys.argv[1:]))
"""
NEVER_ANSWERS = "import sys\nsys.stdin.readline()\nprint('asked', file=sys.stderr, flush=True)\nsys.stdin.readline()"


def test_a_question_to_the_history_that_never_ends_does_not_keep_the_dashboard(tmp_path):
    options = ["--mqtt", f"mqtt://127.0.0.1:{free_port()}", "--site", "lab", "--history", str(tmp_path), "--json"]
    command = [sys.executable, "-c", BUSY, "dashboard", *options]
    (tmp_path / "never_answers.py").write_text(NEVER_ANSWERS)
    (tmp_path / f"site={lab_site().id}").mkdir()
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=os.environ | {"PYTHONPATH": str(tmp_path)}, **pipes) as process:
        page = json.loads(process.stdout.readline())["page"]
        with socket.create_connection(("127.0.0.1", urlsplit(page).port)) as asking:
            asking.sendall(b"GET /api/v1/history/tags HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert "asked\n" in iter(process.stderr.readline, "")
            process.send_signal(signal.SIGINT)
            assert process.wait() == 0
