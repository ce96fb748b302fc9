"""A hub of one server, and the broker of a site whose line to it can be cut."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path

from skyless.run.gather.subjects import NatsAddress
from skyless.run.hub_files import MONITOR_PORT, Hub, Node, with_sites, write_files
from support.processes import free_port

SITE = 7
TENANT = "plant"


class Servers:
    """Their settings and addresses."""

    def __init__(self, folder):
        port = next(port for port in iter(free_port, None) if port < 0xFFFF - MONITOR_PORT)
        hub = Hub((Node("127.0.0.1", port),), fixes_gb=0.1, data=str(folder / "data"))
        self.plan = with_sites(hub, TENANT, [SITE])
        write_files(self.plan, folder)
        self.hub = self.plan.address(TENANT)
        site_port = free_port()
        self.site = NatsAddress(f"nats://127.0.0.1:{site_port}")
        site = {
            "server_name": "site",
            "listen": f"127.0.0.1:{site_port}",
            "jetstream": {"domain": f"site{SITE}", "store_dir": str(folder / "site"), "max_file_store": 1_000_000_000},
            "mqtt": {"listen": f"127.0.0.1:{free_port()}"},
            "leafnodes": self.plan.leaf(TENANT, SITE).configuration(),
        }
        self._files = {"hub": folder / self.plan.nodes[0].name / "nats-server.conf", "site": folder / "site.json"}
        self._files["site"].write_text(json.dumps(site))

    @contextlib.contextmanager
    def running(self, name):
        """One of the servers."""
        server = Path(sys.executable).with_name("nats-server")
        with subprocess.Popen([server, "-c", self._files[name]], stderr=subprocess.DEVNULL) as process:
            try:
                yield
            finally:
                process.kill()
