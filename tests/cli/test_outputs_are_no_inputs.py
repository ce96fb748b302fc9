"""No command writes over a file that it reads, by whatever name it is called."""

import pytest

from skyless.cli.main import main

RECORDING = "t_s,idA,idB,tdoa_m\n0.0,1,2,0.5\n"
ANCHORS = "id,x_m,y_m,z_m\n1,0,0,0\n2,4,0,0\n3,0,4,0\n"


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "recording.csv").write_text(RECORDING)
    (tmp_path / "anchors.csv").write_text(ANCHORS)
    (tmp_path / "soft.csv").symlink_to("recording.csv")
    (tmp_path / "hard.csv").hardlink_to("recording.csv")
    return tmp_path


@pytest.mark.parametrize(
    "outputs",
    [
        ["--fixes-csv", "recording.csv"],
        ["--fixes-csv", "./recording.csv"],
        ["--fixes-csv", "soft.csv"],
        ["--fixes-csv", "hard.csv"],
        ["--fixes-csv", "anchors.csv"],
        ["--plot", "recording.csv"],
        ["--fixes-csv", "new.svg", "--plot", "new.svg"],
    ],
)
def test_replay_spares_what_it_reads(files, complaint, outputs):
    before = sorted(entry.name for entry in files.iterdir())
    assert f"{outputs[-2]} is" in complaint("replay", "recording.csv", "--anchors", "anchors.csv", *outputs)
    assert (files / "recording.csv").read_text() == RECORDING
    assert (files / "anchors.csv").read_text() == ANCHORS
    assert sorted(entry.name for entry in files.iterdir()) == before


def test_simulate_spares_its_site(tmp_path, complaint):
    site = tmp_path / "site.toml"
    assert main(["site", "new", str(site)]) == 0
    before = site.read_bytes()
    assert "site.toml" in complaint("simulate", "--site", site, "--duration", "3", "--fixes-csv", site)
    assert site.read_bytes() == before
