"""Recordings of MULoc: TX stamps as their rule gives them, anchors and truth from the file, and what is damaged."""

import numpy as np
import pytest
from test_formats import muloc_file

import skyless
from skyless.core.air.masterless_packets import Relay
from skyless.core.errors import ConfigurationError
from skyless.research.foreign import datasets as muloc
from skyless.research.foreign.formats import open_recording


def test_stamps_anchors_and_stops(tmp_path):
    path = tmp_path / "one.npz"
    path.write_bytes(muloc_file())
    with open_recording(path) as recording:
        (packet,) = recording
    assert (packet.anchor, packet.rx_ticks) == (1, 1000 + (600 << 16) + 32_880)
    assert packet.tx_ticks == (5_000 + 600 * 65_536) // 512 * 512 + 32_880
    assert packet.relays == (Relay(0, 0, 5_000, None),)
    assert recording.drops == {"tx-stamp-unknown": 3}
    assert muloc.muloc_anchors(path)[2] == (3.0, 4.0, 0.0)
    truth = muloc.muloc_truth(path, None)
    assert truth.t_s.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0, 3.0, 3.25, 3.5, 3.75, 4.0]
    assert truth.position_m[[0, -1]].tolist() == [[1.0, 1.0, 0.0], [2.0, 1.0, 0.0]]


IQ, RCPHASE = np.zeros((1, 4, 5, 2), dtype=np.int16), np.zeros((1, 4, 5), dtype=np.uint8)
IQ[0, 0, 1], RCPHASE[0, 0, 1] = (0, 700), 32  # a quarter of a cycle, and the same turned back
IQ[0, 1, 4], RCPHASE[0, 1, 4] = (-700, 0), 1


def read(path, channel, **changed):
    path.write_bytes(muloc_file(**{"iq": IQ, "rcphase": RCPHASE} | changed))
    with open_recording(path, channel=channel) as recording:
        return list(recording), recording.drops


def test_one_channel_has_phases(tmp_path):
    (packet,), _ = read(tmp_path / "one.npz", 1)
    assert packet.carrier_phase_cycles == 0.5 - 1 / 128
    assert packet.relays == (Relay(0, 0, 5_000, None, 0.0),)
    assert read(tmp_path / "one.npz", 3)[0] == []
    with pytest.raises(ConfigurationError, match="channel is 2; it should be 1 or 3"):
        read(tmp_path / "one.npz", 2)


@pytest.mark.parametrize("changed", [{"iq": IQ[:0]}, {"rcphase": RCPHASE[:0]}, {"iq": RCPHASE}])
def test_phases_that_do_not_fit_the_rounds_are_damage(tmp_path, changed):
    assert read(tmp_path / "damaged.npz", 1, **changed) == ([], {"damaged-array": 1})


@pytest.mark.parametrize(
    "content",
    [
        muloc_file()[:-300],
        muloc_file(rx_ticks=np.zeros((1, 3, 5), dtype=np.int64)),
        muloc_file(rx_ticks=np.array([[["pickled"]]], dtype=object)),
        muloc_file(rx_ticks=np.array([["text"]])),
    ],
)
def test_damage_is_counted(tmp_path, content):
    path = tmp_path / "damaged.npz"
    path.write_bytes(content)
    with open_recording(path, "muloc") as recording:
        assert list(recording) == []
    assert recording.drops == {"damaged-array": 1}


@pytest.mark.statistical
def test_the_published_recording_is_replayed_without_options(recordings):
    path = recordings / "muloc" / "location1_2.npz"
    if not path.is_file():
        pytest.skip(f"no recording at {path}")
    report = skyless.replay(path).reports["tag"]
    assert report.height_m == 0.0
    assert report.measurements == "packets and phases"
    assert report.judged > 15_000
    assert report.rmse_2d_m < 0.05
    assert report.exceeded_horizontal == 0
    stamps = skyless.replay(path, stamps_only=True).reports["tag"]
    assert (stamps.measurements, stamps.judged) == ("packets", pytest.approx(report.judged, abs=2))
    assert stamps.rmse_2d_m < 0.06
    assert stamps.exceeded_horizontal == 0
    differences = skyless.replay(path, measurements="differences").reports["tag"]
    assert differences.judged > 30_000  # of both channels
