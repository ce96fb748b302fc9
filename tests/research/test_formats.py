import gzip
import io

import numpy as np
import pytest

from skyless.core.errors import ConfigurationError
from skyless.research.foreign.formats import FORMATS, open_recording
from support.capture_makers import binary_record, tdoa3, text_line, yaml_document
from support.synthetic_recordings import CRAZYFLIE_KINDS, crazyflie_log, pcapng, phone_records, uci_binary, uci_text

PACKET = (2, 12345, tdoa3(5, 6, [(1, 2, 3, 33000)]))


def muloc_file(**changed):
    """One round of a MULoc recording in which anchor 0 heard nothing, as the tag did after it."""
    rx_ticks = np.full((1, 4, 5), -1)
    rx_ticks[0, :, 4] = [1000 + k * ((600 << 16) + 32_880) for k in range(4)]
    rx_ticks[0, 0, 1] = 5_000
    arrays = {
        "anchors_m": [[0.0, 0.0], [0.0, 4.0], [3.0, 4.0], [3.0, 0.0]],
        "start_m": [1.0, 1.0],
        "end_m": [2.0, 1.0],
        "stops_s": [[0.0, 1.0], [3.0, 4.0]],
        "index": [7],
        "channel": [1],
        "rx_ticks": rx_ticks,
    }
    file = io.BytesIO()
    np.savez_compressed(file, **(arrays | changed))
    return file.getvalue()


SAMPLES = {
    "muloc": muloc_file(),
    "starloc": (
        b"time_s,from_id,to_id,tx1,rx1,tx2,rx2,tx3,rx3\n"
        b"0.00,1,4,0,0,300000,300020,1900000,1900020\n0.01,1,5,0,0,300000,300020,1900000,1900020\n"
    ),
    "bitcraze-yaml": yaml_document(*PACKET),
    "bitcraze-text": text_line(*PACKET),
    "bitcraze-binary": b"boot\xbc\x00" + binary_record(*PACKET),
    "uci-pcapng": pcapng(b"".join(uci_binary(1))),
    "util-table": b"t_tdoa,idA,idB,tdoa_meas,t_pose\n1,2,3,4,\n,,,,5\n",
    "crazyflie-log": crazyflie_log([(5, 0.0, (1, 2, 0.5))], kinds={5: CRAZYFLIE_KINDS[5]}),
    "tdoa-table": b"t_s,idA,idB,tdoa_m\n1,2,3,4\n",
    "avalue": b"t_host,order,slave,master,status,tx_ticks_u40,rx_ticks_u40\n1,1,A,B,0,5,6\n",
    "uci-binary": b"".join(uci_binary(1)),
    "uci-text": b"".join(uci_text(1)),
    "dl-tdoa-json": b"".join(phone_records(1)),
    "miluv": (
        b"t_s,listener,initiator,responder,L_rx1,L_rx2,L_rx3,I_tx1,R_rx1,R_tx2,I_rx2,R_tx3,I_rx3,"
        b"gt_I_x_m,gt_I_y_m,gt_I_z_m,gt_R_x_m,gt_R_y_m,gt_R_z_m\n"
        b"1,9,8,7,0,20000000,120000000,0,0,20000000,20000000,120000000,120000000,0,0,0,1,0,0\n"
    ),
}


def test_every_format_has_a_sample():
    assert {known.name for known in FORMATS} == SAMPLES.keys()


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize("compressed", [False, True])
def test_the_content_tells_the_format_whatever_the_name(tmp_path, name, compressed):
    file = tmp_path / "recording.dat"
    file.write_bytes(gzip.compress(SAMPLES[name]) if compressed else SAMPLES[name])
    with open_recording(file) as recording:
        assert recording.format.name == name
        assert len(list(recording)) == 1
    assert recording.stream.closed


@pytest.mark.parametrize("name", SAMPLES)
def test_an_empty_recording_of_a_named_format_has_no_records(tmp_path, name):
    file = tmp_path / "empty"
    file.touch()
    with open_recording(file, name) as recording:
        assert list(recording) == []


def test_what_is_no_recording_is_refused_with_the_known_formats(tmp_path):
    file = tmp_path / "letter.txt"
    file.write_text("Dear reader,\n")
    with pytest.raises(ConfigurationError) as caught:
        open_recording(file)
    assert all(known.name in str(caught.value) for known in FORMATS)
    assert "Dear reader" in str(caught.value)


def test_other_refusals_say_why(tmp_path):
    empty = tmp_path / "empty"
    empty.touch()
    blinks = tmp_path / "tdoa.csv"
    blinks.write_text("t_host,src,order,tag,anchor,rx_s,rx_ticks_u40\n")
    text = tmp_path / "text"
    text.write_bytes(SAMPLES["bitcraze-text"])
    avalue = tmp_path / "avalue"
    avalue.write_bytes(SAMPLES["avalue"])
    for arguments, reason in (
        ((tmp_path / "missing",), "No such file"),
        ((empty,), "empty"),
        ((blinks,), "ccp.csv"),
        ((text, "mp3"), "one of bitcraze-yaml"),
        ((text, None, "4"), "one listener only"),
        ((avalue, None, "tag"), "hexadecimal"),
    ):
        with pytest.raises(ConfigurationError, match=reason):
            open_recording(*arguments)
