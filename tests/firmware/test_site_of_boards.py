"""A site of boards only: anchors with their hosts, and tags without any, one of which gpsd reads.

In virtual time, but for gpsd, which reads what there is.
"""

import asyncio
import contextlib
import json
import os
import socket
import subprocess
import threading
import time
import tty
from functools import partial
from math import cos, radians

import numpy as np
import pytest
from emulator.build import HAS_HOST_COMPILER
from emulator.site.emulated_site import EmulatedSite
from emulator.site.host_board import HostBoard
from emulator.site.serial_wire import WireSettings
from msgspec.structs import replace
from site_stage import play

from skyless.core.earth import geodetic
from skyless.core.site import AnchorSite, GeoreferenceSite
from skyless.core.ticks import from_seconds
from skyless.radio.serial.link import OUTPUTS, BoardSettings, Writer
from skyless.sim.lab import lab_site
from skyless.sim.trajectory import Static
from support.gpsd import GPSD
from support.processes import free_port

pytestmark = [
    pytest.mark.statistical,
    pytest.mark.skipif(GPSD is None, reason="gpsd is not installed: apt-get install gpsd"),
    pytest.mark.skipif(not HAS_HOST_COMPILER, reason="make and gcc are not installed"),
]

HALL = GeoreferenceSite(52.513, 13.4, 40.0, 25.0)
LAB = replace(lab_site(), anchors=(*lab_site().anchors, AnchorSite(7, 3.0, 0.0)), georeference=HALL)
PLACES_M = ((2.0, 3.0, 0.0), (4.0, 5.0, 0.0))
PATIENCE_S = 30.0


class BoardsOnly(EmulatedSite):
    """Tags get their settings once, and nothing else."""

    def start_host(self, node):
        if node in self.anchors:
            super().start_host(node)
            return
        number = self.tags.index(node)
        settings = BoardSettings(mode=1, output=OUTPUTS.index(("nmea", "json")[number]), rate_hz=10, tag=number + 1)
        ticks = self.medium.timeline.now_ticks + from_seconds(0.02)
        self.medium.timeline.at(ticks, partial(node.board.receive, Writer().set_tag_config(settings, keep=True)))


class Reports:
    """What comes from somewhere as lines of JSON, read in a thread."""

    def __init__(self, read):
        self.all, self._read = [], read
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self):
        rest = b""
        with contextlib.suppress(OSError):  # the port has gone
            while data := self._read(65536):
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    with contextlib.suppress(ValueError):  # the rest of a line, or a record
                        self.all.append(json.loads(line))


def port_of(path):
    file = os.open(path, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(file)
    return Reports(partial(os.read, file))


def gpsd_of(path):
    port = free_port()
    process = subprocess.Popen([GPSD, "-N", "-n", "-S", str(port), path], stderr=subprocess.DEVNULL)
    for _ in range(200):
        try:
            client = socket.create_connection(("127.0.0.1", port))
            break
        except OSError:
            time.sleep(0.1)
    client.sendall(b'?WATCH={"enable":true,"json":true}\n')
    return process, Reports(client.recv)


async def more(site, reports, wanted, count=3):
    """The next reports of a kind; the site goes on until they have come."""
    first, deadline = len(reports.all), time.perf_counter() + PATIENCE_S
    while len(found := [one for one in reports.all[first:] if wanted(one)]) < count:
        assert time.perf_counter() < deadline
        await asyncio.sleep(0.2)
        time.sleep(0.01)
    return found


def east_and_north_m(report, place_m):
    latitude_deg, longitude_deg, _ = geodetic(place_m, HALL)
    east_m = (report["lon"] - longitude_deg) * 111_320.0 * cos(radians(latitude_deg))
    return np.array([east_m, (report["lat"] - latitude_deg) * 111_270.0])


def test_gpsd_and_a_reader_of_json_have_the_tags_positions_through_faults():
    site = BoardsOnly(LAB, [Static(*place) for place in PLACES_M], HostBoard, seed=2, wire=WireSettings(piece_bytes=64))

    async def script(site):
        nmea, lines = site.tags
        await asyncio.sleep(0.5)
        (process, reports), fixes = gpsd_of(nmea.wire.path), port_of(lines.wire.path)
        try:
            for fault in (None, "anchor", "tag"):
                if fault == "anchor":
                    await site.stop_host(site.anchors[2])
                    await asyncio.sleep(1.0)
                elif fault == "tag":
                    for tag in site.tags:
                        site.brown_out(tag, "both")
                    await asyncio.sleep(1.0)
                tpvs = await more(site, reports, lambda one: one["class"] == "TPV" and "lat" in one)
                gsts = await more(site, reports, lambda one: one["class"] == "GST")
                assert np.linalg.norm(east_and_north_m(tpvs[-1], PLACES_M[0])) < 3.0 * gsts[-1]["rms"] < 0.3
                last = (await more(site, fixes, lambda one: "position_m" in one))[-1]
                assert last["tag"] == "tag2"
                assert np.linalg.norm(np.subtract(last["position_m"], PLACES_M[1])) < 3.0 * last["std_m"] < 0.3
        finally:
            process.terminate()
            process.wait()

    play(site, script)
