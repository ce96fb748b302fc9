"""What the commands of a running site say to wrong input, before anything starts."""

import json
import signal
from pathlib import Path

import pytest

import skyless
from skyless.cli.main import main
from skyless.cli.nodes.demo import _subscriber
from skyless.core.errors import SkylessError
from skyless.run.mqtt.address import MqttAddress
from skyless.run.process import hold_any
from support.processes import SKYLESS, started

pytestmark = pytest.mark.site


@pytest.mark.parametrize(("key", "phases"), [("", False), ("carrier_phase = true\n", True)])
def test_anchors_of_a_site_that_relays_phases_ask_their_radios_for_them(key, phases, tmp_path, monkeypatch):
    """Anchors of other sites do not: reading a phase takes a radio's time."""
    site, asked = tmp_path / "site.toml", []

    def open_radios(*_, **options):
        asked.append(options["phases"])
        raise SkylessError("enough")

    monkeypatch.setattr("skyless.cli.nodes.anchor.open_radios", open_radios)
    site.write_text(f'name = "x"\nid = 1\n[schedule]\nmode = "free"\n{key}[[anchors]]\nid = 1\nx_m = 0\ny_m = 0\n')
    assert main(["anchor", "1", "--site", str(site)]) == 2
    assert asked == [phases]


@pytest.mark.parametrize(
    ("command", "right"),
    [
        ("anchor", "IDS is missing; it should be one or more of the site's, each once: 1 2 3 4 5 6"),
        ("anchor 1 1", "IDS is 1 1"),
        ("anchor 7", "IDS is 7"),
        ("tag", "NAMES is missing"),
        ("tag a a", "NAMES is 'a a'"),
        (f"tag {'x' * 33}", "1 to 32 letters"),
        ("tag t --method magic", "it should be one of literal"),
        ("tag t --radio serial:", "it should name one port, as serial:/dev/ttyACM0"),
        ("tag t u --radio phone://0.0.0.0", "it is one phone, which is one tag, not 2"),
        ("tag t --radio phone://0.0.0.0:x", "it should be phone://HOST[:PORT] with a port from 1 to 65535"),
        ("tag t --radio sniffer:/dev/ttyACM0", "--anchors is missing; a sniffer needs a table"),
        ("tag t --anchors a.csv", "--anchors is 'a.csv'; it should be left out: it is for sniffers"),
        ("tag t --radio wifi:x", "it should be ether:HOST[:PORT], serial:PATH[@BAUD]"),
        ("anchor 1 2 --radio serial:/dev/ttyACM0", "it should name 2 ports, one for each node, with commas"),
        ("anchor 1 --radio listener:/dev/ttyACM0", "it should be one that can transmit: a listener only listens"),
        ("board tag1 --radio serial:/dev/ttyACM0", "it should be the emulated air, ether:HOST[:PORT]"),
        ("board tag1 --link /", "--link is '/'; it should be a free name, and this path exists"),
        ("tag t --integrity-risk 0", "--integrity-risk"),
        ("tag t --integrity-risk 0.2", "--integrity-risk"),
        ("tag t --method weighted --alert-limit-m 0.5", "weighted gives no protection levels"),
        ("demo --history /dev/null", "--history is '/dev/null', which is no folder"),
        ("broker --history /dev/null", "--history is '/dev/null', which is no folder"),
        ("history run --to /dev/null --mqtt mqtt://127.0.0.1:1", "--to is '/dev/null', which is no folder"),
        ("demo --paper --method weighted --integrity-risk 1e-5", "--integrity-risk is 1e-05; it should be left out"),
        ("tag t --alert-limit-m -1", "--alert-limit-m"),
        ("tag t --radio sniffer:/dev/x --integrity-risk 1e-5", "1e-05; it should be left out: it is not for sniffers"),
        ("demo --integrity-risk high", "--integrity-risk"),
        ("demo --alert-limit-m inf", "--alert-limit-m"),
        ("ether --site lab:loud", "--site is 'lab:loud'; it should be a site file, lab, paper, or lab:PICOSECONDS"),
        ("ether --listen 127.0.0.1:port", "--listen is '127.0.0.1:port'; it should be HOST:PORT"),
        ("ether --listen 70000", "--listen is '70000'"),
        ("ether --move 4", "--move is '4'; it should be ANCHOR=DX,DY@SECONDS"),
        ("ether --move 9=1,0@5", "--move is '9=1,0@5'; its anchor should be one of the site's: 1, 2, 3, 4, 5, 6"),
        ("ether --move 4=1@5", "--move is '1'; it should be 2 or 3 numbers"),
        ("ether --move 4=1,0@0", "the time after @ should be more than 0 s"),
        ("demo --mqtt none", "the demo needs a broker"),
        ("record --mqtt none", "it should be the broker of the site to record"),
        ("doctor --radio ether:127.0.0.1", "it should be a board, serial:PATH[@BAUD]"),
        ("doctor --radio serial:/dev/null@x", "PATH@BAUD"),
        ("doctor --radio serial:", "it should name one port"),
        ("doctor --site none.toml", "none.toml"),
        ("doctor --duration 0", "--duration"),
        ("doctor --report /nowhere/x.md", "it should be a file in a folder that exists"),
        ("watch --mqtt none", "it should be the broker of the site to watch"),
    ],
)
def test_wrong_input_is_told_with_what_would_be_right(command, right, complaint):
    assert right in complaint(*command.split())


@pytest.mark.parametrize("height", ["high", "nan"])
def test_a_sniffer_s_height_is_metres_or_a_word(height, tmp_path, complaint):
    table = tmp_path / "anchors.csv"
    table.write_text("id,x_m,y_m,z_m\n1,0,0,0\n2,5,0,0\n3,0,5,0\n")
    command = ["tag", "t", "--radio", "sniffer:/dev/x", "--anchors", str(table), "--tag-height", height]
    assert f"--tag-height is '{height}'; it should be metres, free or auto" in complaint(*command)


@pytest.mark.parametrize(
    ("address", "words"),
    [
        (MqttAddress("127.0.0.1", 1884), "mosquitto_sub -p 1884"),
        (MqttAddress("hall", 1883, user="a b"), "mosquitto_sub -h hall -p 1883 -u 'a b' -P \"$SKYLESS_MQTT_PASSWORD\""),
        (MqttAddress("hall", 8883, tls=True, ca=Path("c.pem")), "mosquitto_sub -h hall -p 8883 --cafile c.pem"),
        (MqttAddress("hall", 8883, tls=True), "mosquitto_sub -h hall -p 8883 --tls-use-os-certs"),
    ],
)
def test_the_demo_tells_how_to_watch_its_broker(address, words):
    assert _subscriber(address) == words


def test_a_recorder_that_found_no_site_says_so_with_its_exit_code(tmp_path, capsys):
    port, held = hold_any("127.0.0.1")
    held.close()
    broker = f"mqtt://127.0.0.1:{port}"
    assert main(["record", str(tmp_path / "a.mcap"), "--mqtt", broker, "--duration", "0.2"]) == 1
    assert "nothing was recorded" in capsys.readouterr().out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.statistical
def test_a_program_that_is_asked_to_end_does_so_as_planned(number):
    with started(*SKYLESS, "ether", "--mqtt", "none", "--listen", "0") as program:
        assert "ether at" in program.stderr.readline()
        program.send_signal(number)
        assert program.wait(timeout=10) == 0
        assert not program.stderr.read()


@pytest.mark.parametrize("speaks", ["listener", "sniffer", "sniffer-text", "uci", "uci-2"])
def test_an_anchor_has_no_board_that_only_listens(speaks, complaint):
    assert "it should be link for an anchor" in complaint("board", "6", "--wire", speaks)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_board_tells_where_it_is_and_takes_its_link_with_it(number, tmp_path):
    place = tmp_path / "board"
    command = ("board", "tag1", "--radio", "ether:127.0.0.1:1", "--json", "--link", place)
    with started(*SKYLESS, *command) as program:
        told = json.loads(program.stdout.readline())
        assert told.pop("skyless_version") == skyless.__version__
        assert told == {"board": "tag1", "path": str(place), "format": "link", "radio": f"serial:{place}"}
        assert "no ether at 127.0.0.1:1" in program.stderr.readline()
        assert place.resolve().is_char_device()
        program.send_signal(number)
        assert program.wait(timeout=10) == 0
        assert not place.is_symlink()
