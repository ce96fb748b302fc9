"""What a user does runs: the README's two commands on a fresh copy, and all that an installed wheel has to do.

The shell is a user's: an empty home, nothing of a developer's environment, Python writes bytecode. Settings of package
indexes stay, and what uv has downloaded is not downloaded again.
"""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import pytest

from support.processes import free_port, usual_signals

pytestmark = [pytest.mark.live, pytest.mark.timeout(2400)]

ROOT = Path(__file__).parents[2]
INDEX_SETTINGS = re.compile(r"(PIP|UV|SSL)_\w+|\w+_(proxy|PROXY)|(REQUESTS|CURL)_CA_BUNDLE|CC")
WAIT_S = 1500
"""A slow machine compiles for a while, and a fresh copy's unit tests take minutes on it."""


@pytest.fixture(scope="module")
def shell(tmp_path_factory):
    """The environment of a user's shell."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "uv"
    kept = {name: value for name, value in os.environ.items() if INDEX_SETTINGS.fullmatch(name)}
    path = os.pathsep.join(part for part in os.environ["PATH"].split(os.pathsep) if not part.startswith(str(ROOT)))
    kept |= {"UV_SYSTEM_CERTS": "true", "UV_NATIVE_TLS": "true"}  # as scripts/environment has it
    return {"UV_CACHE_DIR": str(cache), **kept, "HOME": str(tmp_path_factory.mktemp("home")), "PATH": path}


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A copy of the files under git, and of new ones that git does not ignore."""
    folder = tmp_path_factory.mktemp("fresh") / "skyless"
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    for name in subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0"):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def run(shell, *words, cwd=None):
    """What a command prints; it has to end well."""
    command = [str(word) for word in words]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=shell, cwd=cwd, timeout=WAIT_S)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def page_at(address):
    """What a page's server answers, once it has started."""
    for _ in range(WAIT_S):
        with contextlib.suppress(OSError), urllib.request.urlopen(address, timeout=WAIT_S) as answer:
            return answer.read().decode()
        time.sleep(1)
    return ""


def test_the_readme_s_commands_on_a_fresh_copy(checkout, shell):
    readme = (checkout / "README.md").read_text("utf-8")
    demo, test = re.findall(r"^(scripts/\S+(?: unit)?)\s+# ", readme, re.MULTILINE)
    assert (demo, test) == ("scripts/run", "scripts/test unit")
    how = {"cwd": checkout, "env": shell, "text": True, "preexec_fn": usual_signals()}
    running = subprocess.Popen([demo], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **how)
    try:
        said = running.stdout.readline()
        while not (page := re.search(r"http://127\.0\.0\.1:\d+", said)):
            assert running.poll() is None, said
            said += running.stdout.readline()
        assert "<title>" in page_at(page[0])
    finally:
        running.send_signal(signal.SIGINT)
        said += running.communicate(timeout=WAIT_S)[0]
    assert running.returncode in (0, 130), said
    assert "Traceback" not in said
    assert re.search(r"\d+ passed", run(shell, *test.split(), cwd=checkout))


def test_an_installed_wheel_runs_the_demo_a_modelled_radio_and_the_examples(checkout, shell, tmp_path):
    uv = shutil.which("uv") or str(ROOT / ".venv-uv" / "uv")
    image = checkout / "firmware" / "build" / "skyless-dwm1001.hex"
    image.parent.mkdir(exist_ok=True)
    image.write_text(":00000001FF\n")
    run(shell, uv, "build", "--quiet", "--wheel", "--out-dir", tmp_path, checkout, cwd=tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    environment = tmp_path / "environment"
    run(shell, uv, "venv", "--quiet", "--python", Path(sys.executable).resolve(), environment)
    python, skyless = environment / "bin" / "python", environment / "bin" / "skyless"
    run(shell, uv, "pip", "install", "--quiet", "--python", python, f"{wheel}[page,history,research]")

    (carried,) = environment.glob("lib/*/site-packages/skyless/radio/serial/*.hex")
    assert carried.read_text() == image.read_text()
    assert json.loads(run(shell, skyless, "demo", "--duration", "3", "--json", cwd=tmp_path))["fixes"] > 0

    air, broker = f"127.0.0.1:{free_port()}", ("--mqtt", "none")
    numbers = [str(number) for number in range(1, 7)]
    common = {"env": shell, "cwd": tmp_path, "stdout": subprocess.PIPE, "text": True, "preexec_fn": usual_signals()}
    programs = [
        [skyless, "ether", "--tags", "1", "--listen", air, *broker],
        [skyless, "anchor", *numbers, "--radio", f"ether:{air}", *broker],
        [skyless, "tag", "tag1", "--radio", f"model:{air}", "--json", *broker],
    ]
    processes = [subprocess.Popen([str(word) for word in words], **common) for words in programs]
    try:
        fix = json.loads(processes[-1].stdout.readline())
        assert fix["tag"] == "tag1"
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
        for process in processes:
            process.communicate(timeout=WAIT_S)
    assert list(environment.glob("lib/*/site-packages/skyless/radio/dw1000/__pycache__/*.pyc"))
    for example in sorted((ROOT / "examples").glob("*.py")):
        shutil.copy(example, tmp_path)
        assert run(shell, python, example.name, cwd=tmp_path).strip(), example.name
