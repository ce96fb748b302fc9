"""Logs of a Crazyflie's SD card, UTIL's tables and captures of UCI, made here by their descriptions."""

from collections import Counter
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import skyless
from skyless.radio.foreign import fira
from skyless.research.foreign.formats import format_of, open_recording
from skyless.research.replays.captures import known_anchors
from support import synthetic_recordings as synthetic

ROWS = 3000


def differences():
    rows = b"".join(synthetic.tdoa_table(ROWS)).decode().splitlines()[1:]
    return [(float(t), int(a), int(b), float(d)) for t, a, b, d in (row.split(",") for row in rows)]


def flight(version=2, candidates=False, chosen=True):
    """The flight of the other synthetic recordings, with poses, ranger and barometer 50 times a second."""
    kinds = ([5] if chosen else []) + ([6] if candidates else [])
    events = [(number, 1.0 + t, (a, b, d)) for t, a, b, d in differences() for number in kinds]
    for t in np.arange(0.0, ROWS * synthetic.PERIOD_S, 0.02):
        x, y, z = synthetic.place_m(t)
        events += [
            (7, 1.0 + t, (x, y, z, 0.0, 0.0, 0.0, 1.0)),
            (9, 1.0 + t, (round(1000 * z),)),
            (10, 1.0 + t, (z + 500.0,)),
        ]
    used = {number: kind for number, kind in synthetic.CRAZYFLIE_KINDS.items() if number in (*kinds, 7, 9, 10)}
    return synthetic.crazyflie_log(sorted(events, key=lambda event: event[1]), version, used)


@pytest.fixture
def write(tmp_path):
    (tmp_path / "anchors.csv").write_text(synthetic.anchors_csv())

    def to(data, name="log05"):
        (tmp_path / name).write_bytes(data)
        return tmp_path / name

    return to


def replayed(path, **asked):
    return skyless.replay(path, anchors=path.with_name("anchors.csv"), **asked).reports["tag"]


@pytest.mark.site
@pytest.mark.parametrize(("version", "candidates"), [(1, False), (2, False), (2, True)])
def test_a_log_gives_differences_truth_and_heights(write, version, candidates):
    path = write(flight(version, candidates, chosen=not candidates))
    report = replayed(path)
    assert (report.format, report.receptions, report.drops.get("wrong-checksum", 0)) == ("crazyflie-log", ROWS, 0)
    assert report.rmse_3d_m < 0.3
    for asked in ({"height_kind": "sensor"}, {"height_kind": "barometer"}):
        assert replayed(path, heights="recording", **asked).rmse_axes_m[2] < report.rmse_axes_m[2]


def test_candidates_are_used_where_both_are_logged(write):
    events = [(6, t, (a, b, d)) for t, a, b, d in differences()]
    events += [(5, t, (a, b, d)) for t, a, b, d in differences()[::3]]
    assert replayed(write(synthetic.crazyflie_log(sorted(events, key=lambda event: event[1])))).receptions == ROWS


@given(cut=st.floats(0.0, 1.0), flipped=st.integers(0, 10_000), junk=st.binary(max_size=200))
def test_damaged_logs_are_counted(tmp_path_factory, cut, flipped, junk):
    """Whatever is broken off, wrong or added: what comes is a difference, and something is counted."""
    whole = synthetic.crazyflie_log([(5, k / 100.0, (k % 8, (k + 1) % 8, 0.5)) for k in range(100)])
    damaged = bytearray(whole[: max(40, int(cut * len(whole)))] + junk)
    damaged[40 + flipped % (len(damaged) - 39) - 1] ^= 0x40
    path = tmp_path_factory.mktemp("log") / "log"
    path.write_bytes(damaged)
    with open_recording(path, "crazyflie-log") as recording:
        found = list(recording)
    assert len(found) <= 100 + len(junk)
    assert sum(recording.drops.values()) > 0


@pytest.mark.site
def test_tables_of_util_hold_other_sensors_beside(write):
    rows = differences()
    lines = [
        "t_tdoa,idA,idB,tdoa_meas,t_tof,tof,t_baro,baro,t_pose,pose_x,pose_y,pose_z,pose_qx,pose_qy,pose_qz,pose_qw"
    ]
    for number in range(2 * ROWS):
        t = number * 0.005
        x, y, z = synthetic.place_m(t)
        tdoa = "{},{}.0,{}.0,{}".format(*rows[number]) if number < ROWS else ",,,"
        lines.append(f"{tdoa},{t},{z},{t},{z + 80},{t},{x},{y},{z},0,0,0,1")
    path = write(("\n".join(lines) + "\n").encode(), "util.csv")
    report = replayed(path)
    assert (report.format, report.receptions, report.drops.get("blank-field", 0)) == ("util-table", ROWS, 0)
    assert report.rmse_3d_m < 0.3
    assert replayed(path, heights="recording").rmse_axes_m[2] < 0.5 * report.rmse_axes_m[2]


def test_a_recording_without_heights_says_so(write):
    path = write(b"".join(synthetic.tdoa_table(100)), "table.csv")
    with pytest.raises(skyless.SkylessError, match="heights is 'recording'; it should be a table: the recording holds"):
        replayed(path, heights="recording")


@pytest.mark.parametrize("order", ["<", ">"])
def test_uci_comes_out_of_a_capture_as_it_went_in(order):
    packets = [bytes(range(k, k + 7)) for k in range(5)]
    capture = synthetic.pcapng(*packets, order=order)
    assert fira.recognise_pcapng(capture)
    drops = Counter()
    bodies = [body for kind, body, _ in fira._blocks(iter((capture[:50], capture[50:])), drops) if kind == 6]
    assert [body[20 : 20 + len(packets[0])] for body in bodies] == packets
    assert not drops
    assert list(fira.read_pcapng(BytesIO(capture[:-3]), drops)) == []
    assert drops["unfinished-block"] == 1


def test_the_shared_log_is_its_own_table(recordings):
    """The differences of a real log are those that others took out of it."""
    with open_recording(recordings / "bitcraze_log05" / "log05") as log05:
        found = [(one.time_s, one.anchor_a, one.anchor_b, one.tdoa_m) for one in log05]
    assert not log05.drops
    table = np.genfromtxt(recordings / "bitcraze_log05" / "log05_tdoa.csv", delimiter=",", skip_header=1)
    assert np.array(found) == pytest.approx(table, abs=1e-6)
    anchors_m, _ = known_anchors(recordings / "bitcraze_log05" / "anchor_positions.yaml", None)
    assert len(anchors_m) == 8
    assert format_of(recordings / "bitcraze_log05" / "log05").name == "crazyflie-log"
