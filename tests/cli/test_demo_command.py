"""``skyless demo`` as its user meets it: in a pipe, in a terminal, and stopped by Ctrl-C."""

import json
import os
import pty
import re
import signal
import sys
import threading
import time

import pytest

from skyless.cli.main import main

COMMAND = [sys.executable, "-m", "skyless.cli.main", "demo"]


def test_json(capfd):
    assert main(["demo", "--duration", "2", "--json"]) == 0
    out, err = capfd.readouterr()
    assert out.count("\n") == 1
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f]", out + err)
    told = json.loads(out)
    assert told.keys() >= {"tags", "fixes", "rmse_m", "max_m", "updates_per_s"}
    assert told["tags"] == 3
    assert told["duration_s"] == 2.0
    assert told["updates_per_s"] == pytest.approx(400.0, rel=0.01)
    assert told["fixes"] == pytest.approx(3 * 1.0 / 0.015, abs=6)  # judged after 1 s, one a superframe
    assert 0.0 < told["rmse_m"] < 0.05
    assert told["rmse_m"] < told["max_m"] < 0.2


def test_a_pipe_gets_the_tables_once(capfd):
    assert main(["demo", "--duration", "1.2", "--tags", "2"]) == 0
    out, _ = capfd.readouterr()
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f]", out)
    assert out.count("error cm") == 1
    assert re.search(r"2 tags, \d+ messages in 1.2 s: RMSE", out)


@pytest.mark.parametrize("option", [["--json"], []])
def test_interrupt_ends_it_well_and_with_a_summary(option, capfd):
    begun = threading.Event()
    stopper = threading.Thread(target=interrupt_once_in, args=("_in_real_time", threading.get_ident(), begun))
    stopper.start()
    code = main(["demo", *option])
    stopper.join()
    out, err = capfd.readouterr()
    assert begun.is_set()
    assert code == 0
    assert "stopped" in err
    if option:
        assert json.loads(out)["duration_s"] >= 1.5
    else:
        assert "updates per second and tag" in out.splitlines()[-1]


def interrupt_once_in(function, thread, begun):
    """Ctrl-C, 2 s after the function has been entered."""
    while not begun.is_set():
        time.sleep(0.02)
        frame = sys._current_frames().get(thread)
        while frame is not None and frame.f_code.co_name != function:
            frame = frame.f_back
        if frame is not None:
            begun.set()
    time.sleep(2.0)
    os.kill(os.getpid(), signal.SIGINT)


def test_on_a_terminal_the_picture_is_drawn_again_and_again_until_ctrl_c():
    process, terminal = pty.fork()
    if process == 0:
        os.environ.update(TERM="xterm", COLUMNS="80", LINES="40")
        os.execv(COMMAND[0], COMMAND)
    written, pressed = b"", False
    try:
        while data := os.read(terminal, 65536):
            written += data
            if not pressed and written.count(b"synchronisation") >= 6:
                pressed = True
                os.write(terminal, b"\x03")
    except OSError:  # the program has gone
        pass
    _, status = os.waitpid(process, 0)
    os.close(terminal)
    assert os.waitstatus_to_exitcode(status) == 0
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.decode())
    assert "Traceback" not in text
    assert max(len(line) for line in text.replace("\r", "\n").split("\n") if "│" in line) <= 80
    assert "Ctrl-C stops" in text
    assert "updates per second" in text or "no fix was made" in text


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--duration", "-1"], "--duration"),
        (["--duration", "nan"], "--duration"),
        (["--tags", "0"], "--tags"),
        (["--speed", "100"], "--speed"),
        (["--noise-ps", "inf"], "--noise-ps"),
        (["--seed", "x"], "--seed"),
        (["--port", "4"], "--port"),
    ],
)
def test_a_mistake_is_told_in_one_line(capsys, arguments, said):
    code = main(["demo", *arguments])
    out, err = capsys.readouterr()
    assert (code, out) == (2, "")
    assert err.startswith("skyless: ")
    assert err.count("\n") == 1
    assert said in err
