"""The target ``ros2://``: it runs the node of the ROS 2 package ``ros2/skyless_ros2``, which reads its JSON lines.

ros2://?domain=0&frame=site&namespace=skyless&tf=no
"""

import os
import re
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from skyless.bridges.jsonl import JsonLines
from skyless.bridges.rosbag import FRAME_NAME, FRAME_RULE
from skyless.bridges.target import BridgeContext, Target, TargetUrl
from skyless.bridges.targets import StreamTarget, TcpServer
from skyless.core.errors import SkylessError
from skyless.run.process import Child, Program, together

_NODE: Final = "lib/skyless_ros2/node"
"""Where it is, as for ``ros2 run``, below a folder of AMENT_PREFIX_PATH."""

_MAX_DOMAIN: Final = 232
"""Ports of DDS would exceed 65535 beyond it."""

_NAMESPACE: Final = re.compile(r"([A-Za-z]\w{0,31}/){0,3}[A-Za-z]\w{0,31}", re.ASCII)


class Ros2Target(StreamTarget):
    """Serves JSON lines on a port of this computer, and keeps a node running that reads them."""

    def __init__(self, text: str, node: Program, context: BridgeContext) -> None:
        encoder = JsonLines()
        self._server = TcpServer(text, "127.0.0.1", 0, encoder.greeting)
        super().__init__(text, encoder, self._server)
        self._node, self._log = node, context.log

    async def run(self) -> None:
        """Serve until cancelled, and start the node again whenever it ends."""
        await together(self._server.run(), self._keep_node())

    async def _keep_node(self) -> None:
        await self._server.is_listening.wait()
        port = ("-p", f"port:={self._server.port}")
        await Child(replace(self._node, arguments=(*self._node.arguments, *port)), self._log).run()


def make_target(url: TargetUrl, context: BridgeContext) -> Target:
    """Create the target of an address. Raises SkylessError."""
    frame, namespace = url.text_option("frame", "site"), url.text_option("namespace", "skyless")
    if not FRAME_NAME.fullmatch(frame):
        raise url.wrong(f"with frame= {FRAME_RULE}")
    if not _NAMESPACE.fullmatch(namespace):
        raise url.wrong("with namespace= as topics of ROS begin: letters, digits and _, not a digit first")
    transforms = {"no": "false", "yes": "true"}[url.choice("tf", ("no", "yes"), "no")]
    domain = url.whole_number("domain", 0, 0, _MAX_DOMAIN)
    environment = {"ROS_DOMAIN_ID": str(domain)} if url.has("domain") else {}
    url.check_all_read()
    folders = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    node = next((file for folder in folders if os.access(file := Path(folder) / _NODE, os.X_OK)), None)
    if node is None:
        raise SkylessError(
            f"the target {url.text!r} runs the ROS 2 package skyless_ros2, which this shell does not know: build ros2/ "
            "with colcon and source its setup (docs/tools/ros2.md); for ROS on another computer use jsonl+tcp:"
        )
    above, _, name = namespace.rpartition("/")
    # A value is YAML: without quotes a frame called 7 would be a number.
    given = ("autostart:=true", f"map_frame:='{frame}'", f"publish_tag_tf:={transforms}")
    words = (word for one in (*given, f"publish_map_to_odom:={transforms}") for word in ("-p", one))
    arguments = ("--ros-args", "-r", f"__ns:=/{above}", "-r", f"__node:={name}", *words)
    program = Program(f"{url.text}: node", arguments, logs_lines=True, environment=environment, command=(str(node),))
    return Ros2Target(url.text, program, context)
