"""Captures of Bitcraze's TDoA2 and TDoA3 from the simulated hall, through the command and without a master."""

import json

import pytest

from skyless.cli.main import main
from skyless.research.foreign.formats import open_recording
from support import masterless_world as hall

pytestmark = pytest.mark.site

SECONDS = 8.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("hall")
    (place / "anchors.csv").write_text(hall.anchors_csv())
    for system, capture in hall.CAPTURES.items():
        for speed_mps in (0.0, 1.0):
            room = hall.MasterlessWorld(3, speed_mps)
            records = list(capture(room, SECONDS))
            hall.write_capture(place / f"{system}-{speed_mps}", records)
            (place / f"{system}-{speed_mps}.csv").write_text(hall.truth_csv(SECONDS, speed_mps, records[0][0]))
    return place


@pytest.fixture
def replay(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)

    def run(name, *options):
        arguments = [name, "--anchors", "anchors.csv", "--truth", f"{name}.csv", "--settle", "1", "--json", *options]
        assert main(["replay", *arguments]) == 0
        return json.loads(capsys.readouterr().out)

    return run


@pytest.mark.parametrize("system", hall.CAPTURES)
@pytest.mark.parametrize("speed_mps", [0.0, 1.0])
@pytest.mark.statistical
def test_packets_are_better_than_their_differences(replay, system, speed_mps):
    packets = replay(f"{system}-{speed_mps}")
    assert (packets["format"], packets["measurements"]) == ("bitcraze-binary", "packets")
    assert packets["fixes"] > 0.98 * packets["receptions"]
    assert packets["rmse_2d_m"] < 0.03
    assert packets["rmse_3d_m"] < 0.06
    assert packets["first_fix_s"] < 0.15  # two packets of each anchor, three frames at most
    pairs = replay(f"{system}-{speed_mps}", "--measurements", "differences")
    assert packets["rmse_3d_m"] < pairs["rmse_3d_m"]


@pytest.mark.parametrize("system", hall.CAPTURES)
@pytest.mark.statistical
def test_the_captures_are_of_the_systems(folder, system):
    with open_recording(folder / f"{system}-0.0") as recording:
        packets = list(recording)
    assert not recording.drops
    assert len(packets) == pytest.approx(SECONDS * (476 if system == "tdoa2" else 240), rel=0.05)
    relays = [relay for packet in packets[100:] for relay in packet.relays]
    assert 5.5 < len(relays) / len(packets[100:]) <= 7.0  # of an anchor heard twice in between the newer packet is told
    assert all(32_900 < relay.tof_ticks < 36_000 for relay in relays)  # 11.7 m at most, and the antenna delays


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--measurements", "ranges"], ["ranges", "packets, differences"]),
        (["--measurements", "packets", "--tdoa-std", "0.1"], ["--tdoa-std", "packets"]),
        (["--method", "joint"], ["--method", "skyless record"]),
    ],
)
def test_measurements_that_cannot_be(folder, capsys, options, words):
    assert main(["replay", str(folder / "tdoa2-0.0"), "--anchors", str(folder / "anchors.csv"), *options]) == 2
    err = capsys.readouterr().err
    assert all(word in err for word in words)


def test_packets_are_wanted_of_a_table(tmp_path, complaint):
    table = tmp_path / "table.csv"
    table.write_text("t_s,idA,idB,tdoa_m\n1,2,3,4\n")
    anchors = tmp_path / "anchors.csv"
    anchors.write_text("id,x_m,y_m,z_m\n2,0,0,0\n3,5,0,0\n")
    assert "tdoa-table holds no anchors' packets" in complaint(
        "replay", table, "--anchors", anchors, "--measurements", "packets"
    )


def test_a_noise_of_differences_asks_for_differences(replay):
    assert replay("tdoa3-0.0", "--tdoa-std", "0.2")["measurements"] == "differences"
