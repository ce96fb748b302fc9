"""``skyless flash``: Intel HEX files, and probes and tools that are there, are not, or fail. No board is flashed."""

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyless.cli.main import main
from skyless.cli.nodes import flash
from skyless.core.version import installed_version

pytestmark = pytest.mark.site

VERSION = installed_version()
OBJCOPY = shutil.which("arm-none-eabi-objcopy") or shutil.which("objcopy")
PROBES = {"1-1": ("1366", "J-Link", "000760123456"), "1-2": ("0d28", "DAPLink CMSIS-DAP", "02"), "usb1": ("1d6b",)}
IMAGE = ("flash", "--image", "an image.hex")
VERIFIED = "echo '** Verified OK **'"


def record(address, kind, data):
    raw = bytes([len(data), *address.to_bytes(2, "big"), kind, *data])
    return f":{raw.hex()}{-sum(raw) & 0xFF:02X}\n"


LAST = record(0, 1, b"")


def content_of(version):
    return bytes(64) + f"skyless-dwm1001 {version}\0".encode() + bytes(range(100))


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """Plugs probes in and installs tools, which are scripts, where there is an image."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(flash, "_USB", tmp_path / "usb")
    monkeypatch.setattr(sys, "executable", str(tmp_path / "python"))
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    Path("bin").mkdir()
    Path("an image.hex").write_text(record(0, 0, content_of(VERSION)) + LAST)

    def put(*probes, **tools):
        for name in probes:
            Path("usb", name).mkdir(parents=True)
            for file, text in zip(("idVendor", "product", "serial"), PROBES[name], strict=False):
                Path("usb", name, file).write_text(f"{text}\n")
        for name, script in tools.items():
            tool = Path("bin", name)
            tool.write_text(f'#!/bin/sh\nPATH=/usr/bin:/bin\nprintf "%s\\n" "$@" >ran\n{script}\n')
            tool.chmod(0o755)

    return put


@pytest.mark.skipif(OBJCOPY is None, reason="binutils are not installed")
@settings(max_examples=30, deadline=None)
@given(st.integers(0, 0xF0000), st.binary(min_size=1, max_size=2000), st.binary(min_size=1, max_size=40))
def test_what_objcopy_has_written_is_read(tmp_path_factory, address, code, uicr):
    file, lines = tmp_path_factory.mktemp("hex") / "image", []
    for at, content in ((address, code), (0x1000_1200, uicr)):
        file.write_bytes(content)
        subprocess.run([OBJCOPY, "-I", "binary", "-O", "ihex", f"--change-addresses={at}", file], check=True)
        lines = [*lines[:-1], *file.read_text("ascii").splitlines(keepends=True)]
    file.write_text("".join(lines), "ascii")
    assert flash.read_hex(file) == {address: code, 0x1000_1200: uicr}


IMAGES = {
    record(0, 0, b"ab").replace("61", "62"): "bad.hex: line 1 is",
    record(0, 0, b"ab") + "\x7fELF": "bad.hex: line 2 is",
    record(0, 9, b"") + LAST: "bad.hex: line 1 is",
    record(0, 0, b"ab") * 2: "up to its last record",
    record(0, 0, bytes(99)) + LAST: "bad.hex: it should be firmware of Skyless for a DWM1001",
    record(0, 0, content_of("0.0.1")) + LAST: f"of version 0.0.1, and Skyless is {VERSION}; it should be",
}


@pytest.mark.parametrize("text", IMAGES)
def test_a_damaged_foreign_or_old_image_is_named(bench, complaint, text):
    bench("1-1", openocd=VERIFIED)
    Path("bad.hex").write_text(text, "latin-1")
    assert IMAGES[text] in complaint("flash", "--image", "bad.hex", "--yes")
    assert not Path("ran").exists()


MISSING = """
 | openocd | | no debug probe is plugged in: plug in a DWM1001-DEV
1-1 1-2 | openocd | | --serial is ''; it should choose one of the debug probes here: jlink 760123456, cmsis-dap 02
1-1 | openocd | --serial 5 | --serial is '5'
1-1 usb1 | openocd | | --yes flashes without asking
1-1 | | | flashing needs OpenOCD: apt install openocd, or pyocd:
 | pyocd | --probe pi | flashing needs OpenOCD: apt install openocd
1-2 | pyocd | --yes | the module does not hold what was written
1-2 | openocd | --yes | openocd failed (Error: no ACK): check the board's power
"""


@pytest.mark.parametrize("case", MISSING.strip("\n").splitlines())
def test_what_is_missing_or_fails_is_one_sentence(bench, capsys, case):
    probes, tools, options, said = case.split("|")
    scripts = {"openocd": "echo Error: no ACK; echo shutdown; exit 1", "pyocd": "exit 0"}
    bench(*probes.split(), **{name: scripts[name] for name in tools.split()})
    assert main([*IMAGE, *options.split()]) == 2
    assert said.strip() in capsys.readouterr().err.splitlines()[-1]


def test_a_board_is_erased_after_a_yes_alone_and_never_in_a_dry_run(bench, capsys, monkeypatch):
    bench("1-1", "1-2", openocd=VERIFIED)
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True, readline=iter("ny").__next__))
    assert main([*IMAGE, "--probe", "jlink", "--dry-run"]) == 0
    out = capsys.readouterr().out
    words = shlex.split(out.partition("runs:")[2].partition("\n")[0])
    assert words[1:5] == ["-f", "interface/jlink.cfg", "-c", "adapter serial 760123456; transport select swd"]
    assert words[-1].endswith("an\\ image.hex verify reset exit")
    assert "erases:  all flash and UICR of the module" in out
    assert main([*IMAGE, "--serial", "760123456"]) == 2
    assert "nothing was erased" in capsys.readouterr().err
    assert not Path("ran").exists()
    assert main([*IMAGE, "--serial", "760123456", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["command"] == words
    assert json.loads(out)["flashed"]
    assert Path("ran").read_text().splitlines() == words[1:]
    assert "** Verified OK **\nwritten and verified; next: unplug" in err


def test_what_pyocd_has_read_back_is_compared(bench, capsys):
    Path("content").write_bytes(content_of(VERSION))
    bench("1-2", pyocd='for word; do case $word in savemem*) cp content "${word##* }";; esac; done')
    assert main([*IMAGE, "--yes"]) == 0
    assert "written and verified" in capsys.readouterr().out


def test_ctrl_c_ends_the_tool_and_says_what_the_board_holds(bench, monkeypatch):
    said = []

    def interrupt(line):
        said.append(line)
        if line == "begun":
            raise KeyboardInterrupt

    monkeypatch.setattr(flash, "log", interrupt)
    bench(openocd="echo $$ >pid; echo begun; exec sleep 60")
    assert main([*IMAGE, "--yes", "--probe", "pi"]) == 130
    assert said[-1].startswith("interrupted: the board holds a part of the image")
    assert not Path("/proc", Path("pid").read_text().strip()).exists()
