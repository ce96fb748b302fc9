"""A site of real processes for other programs to read: broker, emulated air, anchors and a tag."""

import os
import subprocess
import sys
import threading

import paho.mqtt.publish
import paho.mqtt.subscribe

from skyless.run.process import end_with_parent
from support.processes import free_port
from support.waiting import came

START_S = 120.0

ORIGIN = (48.137, 11.576)
"""Latitude and longitude in degrees."""

_POSITIONS_M = ((0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (6.0, 8.0), (0.0, 8.0), (0.0, 4.0))


def site_text():
    """The site file: the lab's anchors, somewhere on the Earth."""
    lines = ['name = "lab"', "id = 1", "master = 1", "[schedule]", "slot_s = 0.0025", "[tags]", "height_m = 0.0"]
    lines += ["[georeference]", f"latitude_deg = {ORIGIN[0]}", f"longitude_deg = {ORIGIN[1]}", "height_m = 520.0"]
    for number, (x_m, y_m) in enumerate(_POSITIONS_M, start=1):
        lines += ["[[anchors]]", f"id = {number}", f"x_m = {x_m}", f"y_m = {y_m}"]
    return "\n".join(lines) + "\n"


class Process:
    """A program whose lines are kept, and which ends with the test however that ends."""

    def __init__(self, *command, **settings):
        self.lines = []
        self._process = subprocess.Popen(
            [str(word) for word in command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            preexec_fn=end_with_parent(),  # noqa: PLW1509 - the threads only read
            **settings,
        )
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for line in self._process.stdout:
            self.lines.append(line.rstrip())

    def kill(self):
        self._process.kill()
        self._process.wait()

    def stop(self):
        """End it as a person would."""
        self._process.terminate()
        try:
            self._process.wait(timeout=30)
        except subprocess.TimeoutExpired:
            self.kill()

    def said(self, words, limit_s=START_S):
        """Wait until it says something; the test fails if it never does."""
        came(lambda: any(words in line for line in self.lines) or self._process.poll() is not None, limit_s)
        assert any(words in line for line in self.lines), self.lines


class ClientSite:
    """The lab on the Earth with one walking tag, ``tag1``, at Skyless's own broker."""

    def __init__(self, folder):
        self.mqtt_port, self._air_port, self._folder = free_port(), free_port(), folder
        self._file = folder / "site.toml"
        self._file.write_text(site_text(), encoding="utf-8")
        self._processes = []

    def __enter__(self):
        broker = self.run("broker", "--port", self.mqtt_port, "--data", self._folder / "broker", mqtt=False)
        broker.said("mqtt://")
        site = ("--site", self._file)
        self.run("ether", *site, "--tags", 1, "--listen", f"127.0.0.1:{self._air_port}")
        self.run("anchor", *range(1, 7), *site, *self._radio).said("on the air")
        self.start_tag()
        return self

    def __exit__(self, *_):
        for process in reversed(self._processes):
            process.stop()

    @property
    def _radio(self):
        return "--radio", f"ether:127.0.0.1:{self._air_port}"

    def start_tag(self):
        self.tag = self.run("tag", "tag1", *self._radio)

    def run(self, *arguments, mqtt=True):
        """A ``skyless`` program at the site's broker."""
        more = ("--mqtt", f"mqtt://127.0.0.1:{self.mqtt_port}") if mqtt else ()
        environment = {**os.environ, "XDG_DATA_HOME": str(self._folder), "PYTHONUNBUFFERED": "1"}
        process = Process(sys.executable, "-m", "skyless.cli.main", *arguments, *more, env=environment)
        self._processes.append(process)
        return process

    def publish(self, topic, payload, *, retain=False):
        """Publish a message as any MQTT client would."""
        paho.mqtt.publish.single(topic, payload, qos=1, retain=retain, hostname="127.0.0.1", port=self.mqtt_port)

    def retained(self, topic):
        """The payload that the broker keeps."""
        return paho.mqtt.subscribe.simple(topic, hostname="127.0.0.1", port=self.mqtt_port).payload
