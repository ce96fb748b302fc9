"""Files of a hub: nats-server takes them, only their owner reads them, and what is there stays when sites come."""

import json
import subprocess

import pytest

from skyless.cli.main import main
from skyless.run.broker import _program

pytestmark = pytest.mark.site

NODES = ("--node", "127.0.0.1", "--node", "127.0.0.1:4223", "--node", "127.0.0.1:4224")


@pytest.fixture
def certificates(tmp_path):
    subprocess.run(
        "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 30 -keyout key.pem -out cert.pem"
        " -subj /CN=a && cp cert.pem ca.pem",
        shell=True,
        check=True,
        capture_output=True,
        cwd=tmp_path,
    )
    return tmp_path


@pytest.mark.parametrize("nodes", [NODES, NODES[:2], ("--node", "a", "--node", "b:5000", "--node", "c.example")])
def test_nats_server_takes_the_files(nodes, certificates, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")  # paths in one line
    hub = certificates / "hub"
    assert main(["hub", "init", str(hub), *nodes, "--sites", "7,8", "--certificates", str(certificates)]) == 0
    servers = sorted(hub.glob("*/nats-server.conf"))
    assert len(servers) == len(nodes) // 2
    for server in servers:
        subprocess.run([_program(), "-t", "-c", server], check=True, capture_output=True)
    out = capsys.readouterr()
    assert "plant-site7.json" in out.out
    assert ("ca.pem" in out.err) is ("127.0.0.1" not in nodes)


def test_sites_and_tenants_are_added_and_passwords_stay(tmp_path, capsys):
    init = ("hub", "init", str(tmp_path / "hub"), "--json")
    assert main([*init, *NODES, "--sites", "7", "--fixes-gb", "2"]) == 0
    first = json.loads((tmp_path / "hub" / "hub.json").read_bytes())
    leaf = (tmp_path / "hub" / "sites" / "plant-site7.json").read_bytes()
    assert main([*init, "--sites", "8"]) == main([*init, "--tenant", "other", "--sites", "7"]) == 0
    assert main([*init, "--sites", "8"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [len(line["changed"]) for line in lines] == [6, 5, 6, 0]
    second = json.loads((tmp_path / "hub" / "hub.json").read_bytes())
    assert first["passwords"].items() <= second["passwords"].items()
    assert len(set(second["passwords"].values())) == len(second["passwords"])
    assert second["sites"] == {"plant": [7, 8], "other": [7]}
    assert second["fixes_gb"] == 2
    assert (tmp_path / "hub" / "sites" / "plant-site7.json").read_bytes() == leaf
    for file in (tmp_path / "hub").rglob("*"):
        assert not file.stat().st_mode & 0o077


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--node", "a", "--node", "b"), "--node"),
        (("--node", "a b"), "--node is 'a b'"),
        (("--node", "a:65000"), "--node is 'a:65000'"),
        (("--node", "a", "--sites", "7,x"), "--sites is '7,x'"),
        (("--node", "a", "--tenant", "A.b"), "--tenant is 'A.b'"),
    ],
)
def test_mistakes_are_named(words, named, tmp_path, complaint):
    assert named in complaint("hub", "init", tmp_path / "hub", *words)
    assert not (tmp_path / "hub").exists()


def test_a_file_of_something_else_is_named(tmp_path, capsys):
    file = tmp_path / "leaf.json"
    for text in ('{"site": 7}', '{"version": 2}', "x"):
        file.write_text(text)
        assert main(["broker", "--gather", "--hub", str(file)]) == 2
    assert main(["broker", "--gather", "--hub", str(tmp_path / "none")]) == 2
    assert main(["broker", "--hub", str(file)]) == 2
    assert main(["hub", "apply", str(tmp_path)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 6
    assert err.count(str(file)) == 4
