"""A real Home Assistant core at Skyless's own broker: entities, rooms, a killed tag, restarts, removal.

Home Assistant 2025.4.4 is the last version for Python 3.13.0; it is installed into ``.venv-clients/homeassistant``.
"""

import json
import shutil
import subprocess
import time
from pathlib import Path

import msgspec
import pytest
from client_site import ORIGIN, ClientSite, Process

from skyless.run.mqtt.messages import FixMessage, Zone, ZonesMessage
from support.processes import free_port
from support.waiting import came

ENVIRONMENT = Path(__file__).parents[2] / ".venv-clients" / "homeassistant"
PACKAGES = ("homeassistant==2025.4.4", "home-assistant-frontend==20250411.0", "paho-mqtt==2.1.0")
DRIVER = Path(__file__).with_name("home_assistant_driver.py")
KILLED_S = 15.0
"""A killed tag must be unavailable within this time."""

CONFIGURATION = f"""
homeassistant:
  name: Test
  latitude: 50.0
  longitude: 9.0
  unit_system: metric
  time_zone: UTC
http:
  server_host: 127.0.0.1
  server_port: PORT
zone:
  - name: Hall
    latitude: {ORIGIN[0]}
    longitude: {ORIGIN[1]}
    radius: 30
"""
WEST = Zone("z1", "West", ((-9.0, -9.0), (3.0, -9.0), (3.0, 19.0), (-9.0, 19.0)))
EAST = Zone("z2", "East", ((3.0, -9.0), (19.0, -9.0), (19.0, 19.0), (3.0, 19.0)))
ZONES, ZONE = "skyless/v1/1/zones", "skyless/v1/1/tag/tag1/zone"
CONFIG = "homeassistant/device/skyless_1_tag1/config"


def runs(program):
    """Whether it is one that runs: pyenv has programs in the path for versions that are not chosen."""
    return program is not None and subprocess.run([program, "-c", ""], capture_output=True, check=False).returncode == 0


@pytest.fixture(scope="module")
def python():
    """Of an environment with Home Assistant."""
    found = ENVIRONMENT / "bin" / "python"
    if not (ENVIRONMENT / "installed").exists():
        versions = sorted(Path.home().glob(".pyenv/versions/3.13.*/bin/python3.13"), reverse=True)
        base = next(filter(runs, (shutil.which("python3.13"), *versions)), None)
        if base is None:
            pytest.skip("Home Assistant 2025.4.4 needs Python 3.13, which is not installed")
        subprocess.run([base, "-m", "venv", ENVIRONMENT], check=True)
        done = subprocess.run([found, "-m", "pip", "install", "-q", *PACKAGES], check=False)
        if done.returncode:
            pytest.skip("Home Assistant 2025.4.4 cannot be installed: the lines above say why")
        (ENVIRONMENT / "installed").touch()
    return found


class HomeAssistant:
    """A running core, and the newest state of each entity by its unique id."""

    def __init__(self, python, folder, port, *user):
        environment = {"PATH": "/usr/bin:/bin", "HOME": str(folder)}
        process = Process(python, DRIVER, folder, port, *user, env=environment, cwd=folder)
        self.lines, self.stop = process.lines, process.stop
        process.said('"ready"')

    def states(self):
        """By unique id; entities that are gone are left out."""
        states, names = {}, {}
        for line in self.lines:
            value = json.loads(line) if line.startswith("{") else {}
            if value.get("state") is not None:
                names[value["entity"]] = value["unique_id"]
                states[value["unique_id"]] = value
            elif "entity" in value:
                states.pop(names.get(value["entity"]), None)
        return states

    def state(self, key, tag="tag1"):
        return self.states().get(f"skyless_1_{tag}_{key}", {}).get("state")

    def has_rooms(self):
        return self.state("room") in {"West", "East"} and self.state("position") == "Hall"

    def of_tag(self, tag="tag1"):
        return {name: value["state"] for name, value in self.states().items() if name.startswith(f"skyless_1_{tag}_")}


@pytest.fixture
def make_home(python, tmp_path):
    """A function that starts Home Assistant, always with the same folder."""
    folder = tmp_path / "home"
    folder.mkdir()
    (folder / "configuration.yaml").write_text(CONFIGURATION.replace("PORT", str(free_port())), encoding="utf-8")
    homes = []

    def make(port):
        homes.append(HomeAssistant(python, folder, port))
        return homes[-1]

    yield make
    for home in homes:
        home.stop()


def set_zones(site, *zones):
    site.publish(ZONES, msgspec.json.encode(ZonesMessage(zones, "lab")), retain=True)


def walk(site, xs, tag="walker"):
    """Fixes of a tag that only this test has."""
    variance = 0.0004
    for serial, x in enumerate(xs):
        fix = FixMessage(
            tag, serial, time.time(), 0.1 * serial, (x, 4.0, 0.0), (variance, 0, 0, 0, variance, 0, 0, 0, variance),
            None, None, 0.035, 1.0, 1.0, 1.0, None, (1, 2, 3, 4), 1.0, 1, 0.01, "joint", True, 0.001,
        )  # fmt: skip
        site.publish(f"skyless/v1/1/tag/{tag}/fix", msgspec.json.encode(fix))
        time.sleep(0.2)


def test_tags_are_devices_whose_rooms_follow_the_polygons(make_home, tmp_path):
    with ClientSite(tmp_path) as site:
        set_zones(site, WEST, EAST)
        site.run("bridge", "homeassistant:").said("bridging")
        home = make_home(site.mqtt_port)
        came(lambda: len(home.of_tag()) == 5)
        came(home.has_rooms)
        came(lambda: sorted((home.state("zone_z1"), home.state("zone_z2"))) == ["off", "on"])
        came(lambda: home.state("accuracy") not in {"unknown", "unavailable"})
        assert 0.0 < float(home.state("accuracy")) < 0.5
        attributes = home.states()["skyless_1_tag1_position"]["attributes"]
        assert abs(attributes["latitude"] - ORIGIN[0]) < 1e-4
        assert attributes["gps_accuracy"] < 0.5

        walk(site, [1.0, 2.0, 2.99, 3.01, 2.99])
        came(lambda: home.state("room", "walker") == "West", 5.0)
        walk(site, [3.5, 4.0, 4.0, 4.0, 4.0, 4.0])
        rooms = [json.loads(line) for line in home.lines if "skyless_1_walker_room" in line]
        known = [value["state"] for value in rooms if value["state"] not in {"unavailable", "unknown"}]
        assert known[-1] == "East"
        came(lambda: home.state("room", "walker") == "unavailable")  # it sends no more fixes

        before = set(home.states())
        set_zones(site, EAST, Zone("z1", "Library", WEST.polygon_m))
        came(lambda: home.state("room") in {"Library", "East"})
        assert set(home.states()) == before
        set_zones(site, Zone("z1", "All", ((-9, -9), (19, -9), (19, 19), (-9, 19))))
        came(lambda: home.state("room") == "All")
        came(lambda: len(home.of_tag()) == 4)  # the other zone's sensor is removed

        site.publish("homeassistant/device/skyless_1_walker/config", b"", retain=True)
        came(lambda: home.of_tag("walker") == {})


def test_a_killed_tag_is_unavailable_and_a_restarted_home_assistant_has_all_states(make_home, tmp_path):
    with ClientSite(tmp_path) as site:
        set_zones(site, WEST, EAST)
        bridge = site.run("bridge", "homeassistant:")
        home = make_home(site.mqtt_port)
        came(home.has_rooms)
        before = set(home.of_tag())

        site.tag.kill()
        came(lambda: set(home.of_tag().values()) == {"unavailable"}, KILLED_S)
        site.start_tag()
        came(home.has_rooms)

        came(lambda: json.loads(site.retained(ZONE))["usable"])
        status = json.loads(site.retained(CONFIG))["availability"][0]["topic"]
        home.stop()
        online = site.retained(status)
        bridge.kill()
        came(lambda: site.retained(status) != online)
        site.publish(status, online, retain=True)  # as if the bridge were there, but nothing new can come from it
        home = make_home(site.mqtt_port)
        came(home.has_rooms)
        came(lambda: home.state("accuracy") not in {"unknown", "unavailable"})
        assert set(home.of_tag()) == before

        bridge = site.run("bridge", "homeassistant:")
        came(lambda: site.retained(status) != online)
        bridge.kill()
        came(lambda: set(home.of_tag().values()) == {"unavailable"}, KILLED_S)
        site.run("bridge", "homeassistant:")
        came(home.has_rooms)
        assert set(home.of_tag()) == before
