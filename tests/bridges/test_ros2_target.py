"""``ros2://`` runs the ROS 2 node that the shell knows; here a program that writes down what it gets stands for it."""

import json
import sys
from pathlib import Path

import pytest

from skyless.bridges.ros2 import make_target
from skyless.bridges.target import BridgeContext, TargetUrl
from skyless.core.errors import SkylessError
from support.bridged_values import SITE, a_fix
from support.waiting import running, until

pytestmark = pytest.mark.site

NODE = f"""#!{sys.executable}
import json, os, socket, sys
(port,) = (word.removeprefix("port:=") for word in sys.argv if word.startswith("port:="))
with socket.create_connection(("127.0.0.1", int(port))) as link, link.makefile("rb") as lines:
    site, fix = next(lines), next(lines)
found = [os.environ["ROS_DOMAIN_ID"], sys.argv[1:], json.loads(site)["name"], json.loads(fix)["tag"]]
print(json.dumps(found), file=sys.stderr)
"""


@pytest.fixture(autouse=True)
def node(tmp_path, monkeypatch):
    node = tmp_path / "lib" / "skyless_ros2" / "node"
    node.parent.mkdir(parents=True)
    node.write_text(NODE)
    node.chmod(0o755)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path}")
    monkeypatch.setenv("ROS_DOMAIN_ID", "3")
    return node


def target_of(text, log=print):
    return make_target(TargetUrl(text), BridgeContext(log))


@pytest.mark.parametrize(
    ("text", "domain", "names", "frame", "transforms"),
    [
        ("ros2://", "3", ("__ns:=/", "__node:=skyless"), "'site'", "false"),
        ("ros2://?domain=7&frame=7&namespace=hall/uwb&tf=yes", "7", ("__ns:=/hall", "__node:=uwb"), "'7'", "true"),
    ],
)
async def test_the_node_gets_lines_and_parameters_and_is_started_again(text, domain, names, frame, transforms):
    said = []
    target = target_of(text, said.append)
    async with running(target.run()):
        target.on_site(SITE)
        await until(lambda: target.on_fix(a_fix()) or sum("started again" in line for line in said) == 2)
    starts = [json.loads(line.partition(": node: ")[2]) for line in said if ": node: " in line]
    assert len(starts) == 2
    for given, arguments, site, tag in starts:
        assert (given, site, tag) == (domain, SITE.name, "tag1")
        assert [one for one in arguments if one.startswith("__")] == [*names]
        parameters = dict(one.split(":=") for one in arguments if ":=" in one and not one.startswith("__"))
        tf = {"publish_tag_tf": transforms, "publish_map_to_odom": transforms}
        port = parameters["port"]
        assert parameters == {"autostart": "true", "map_frame": frame, "port": port} | tf


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("domain=233", "domain=233"),
        ("domain=x", "domain=x"),
        ("domain=", "domain="),
        ("tf=perhaps", "no or yes"),
        ("frame=a%20b", "frame="),
        ("frame=/map", "frame="),
        ("namespace=1st", "namespace="),
        ("colour=red", "'colour'"),
    ],
)
def test_wrong_settings_are_named(text, words):
    with pytest.raises(SkylessError, match=words):
        target_of(f"ros2://?{text}")


@pytest.mark.parametrize("change", [Path.unlink, lambda node: node.chmod(0o644)])
def test_without_a_package_that_runs_the_message_says_where_to_get_it(node, change):
    change(node)
    with pytest.raises(SkylessError, match=r"runs the ROS 2 package skyless_ros2, .*colcon"):
        target_of("ros2://")
