"""What is packaged runs commands that exist: compose.yaml, its image, units of systemd."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

from skyless.cli.main import program
from skyless.run.mqtt.address import Role

pytestmark = pytest.mark.site

ROOT = Path(__file__).parents[2]
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text(encoding="utf-8"))
UNITS = sorted((ROOT / "packaging" / "systemd").glob("*.service"))
DOCKERFILE = (ROOT / "packaging" / "Dockerfile").read_text(encoding="utf-8")


def commands():
    """Each command of Skyless with its arguments, by where it stands."""
    for name, service in COMPOSE["services"].items():
        yield pytest.param(service["command"], id=f"compose {name}")
    for unit in UNITS:
        if unit.name == "skyless-hub.service":  # of nats-server alone
            continue
        (line,) = re.findall(
            r"^ExecStart=/opt/skyless/bin/skyless (.*)$", unit.read_text(encoding="utf-8"), re.MULTILINE
        )
        line = re.sub(r"\$\{\w*LIMIT\w*}", "1000", re.sub(r"%i", "1", line))
        yield pytest.param(shlex.split(line.replace("$SITE", "--site-id=7")), id=unit.name)


@pytest.mark.parametrize("words", list(commands()))
def test_it_is_a_command_of_skyless(words):
    program().parse_args(words, print_error=False, exit_on_error=False)


def test_the_demo_starts_without_a_profile_and_the_site_brings_its_own_services():
    services = COMPOSE["services"]
    assert [name for name, service in services.items() if "profiles" not in service] == ["demo"]
    assert set(services["site"]["depends_on"]) == services.keys() - {"demo", "site"}
    for name, service in services.items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name


ROLES = {"anchor": Role.ANCHORS, "tag": Role.TAGS} | dict.fromkeys(("dashboard", "record"), Role.PAGE)
ROLES |= {"survey": Role.SURVEY}
"""Of each program that uses the broker."""


def test_each_program_gets_the_password_of_its_role_and_no_other():
    services = [service for name, service in COMPOSE["services"].items() if name not in {"demo", "broker"}]
    for service in services:
        role = ROLES[service["command"][0]]
        assert service["env_file"] == [{"path": f"access/{role}.env", "required": False}]
    found = {}
    for unit in UNITS:
        text = unit.read_text(encoding="utf-8")
        (program,) = re.findall(r"^ExecStart=/opt/skyless/bin/(?:skyless )?([\w-]+)", text, re.MULTILINE)
        found[program] = re.findall(
            r"skyless\.env\n(?:#.*\n)?EnvironmentFile=-/etc/skyless/access/(\w+)\.env$", text, re.M
        )
        assert len(re.findall("access/", text)) == len(found[program])
    assert found == {"broker": [], "nats-server": []} | {program: [role] for program, role in ROLES.items()}


def test_the_image_runs_as_a_user_without_rights_and_holds_only_what_is_copied():
    assert re.search(r"^USER skyless$", DOCKERFILE, re.MULTILINE)
    kept = {
        line.removeprefix("!") for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")
    }
    copied = {
        name for line in re.findall(r"^COPY (?!--from)(.*) \S+$", DOCKERFILE, re.MULTILINE) for name in line.split()
    }
    assert copied == kept
    assert all((ROOT / name).exists() for name in copied)


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.name)
def test_a_unit_is_hardened_and_waits_only_for_units_that_are_there(unit):
    text = unit.read_text(encoding="utf-8")
    lines = text.splitlines()
    assert {"NoNewPrivileges=true", "ProtectSystem=strict"} <= set(lines)
    assert "Restart=" in text or "Type=oneshot" in text
    wanted = re.findall(r"skyless-[\w@]+\.service", text)
    assert set(wanted) <= {other.name for other in UNITS}


def settings(unit):
    """What a unit sets, by name."""
    found = {}
    for name, value in re.findall(r"^(\w+)=(.*)$", unit.read_text(encoding="utf-8"), re.MULTILINE):
        found.setdefault(name, []).append(value)
    return found


def test_no_unit_can_read_what_belongs_to_another():
    """A user each, who is made; seeds lie with the anchors'."""
    users = {}
    for unit in UNITS:
        found, name = settings(unit), unit.name.removesuffix(".service").removesuffix("@")
        assert found["User"] == found["Group"] == found["StateDirectory"] == [name]
        assert found["WorkingDirectory"] == [f"/var/lib/{name}"]
        users[name] = {group for line in found.get("SupplementaryGroups", ()) for group in line.split()}
    assert len(users) == len(UNITS)
    made = (ROOT / "packaging" / "systemd" / "skyless.sysusers.conf").read_text(encoding="utf-8")
    assert set(re.findall(r"^u (\S+) -", made, re.MULTILINE)) == users.keys()
    shared = {name: groups - {"dialout"} for name, groups in users.items() if groups - {"dialout"}}
    assert shared == {"skyless-dashboard": {"skyless-record"}}
    guide = (ROOT / "docs" / "howto" / "raspberry_pi.md").read_text(encoding="utf-8")
    assert "chown -R skyless-anchor: /etc/skyless/keys && chmod 700 /etc/skyless/keys" in guide
    assert "sync --locked" in guide


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not here")
def test_systemd_rates_every_unit_as_well_protected(tmp_path):
    for unit in UNITS:
        (tmp_path / unit.name).write_text(unit.read_text(encoding="utf-8"), encoding="utf-8")
    command = ["systemd-analyze", "security", "--offline=true", "--threshold=25"]
    done = subprocess.run(
        [*command, *(tmp_path / unit.name for unit in UNITS)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-500:] + done.stderr
