"""A hub of one server, and the broker of a site whose line to it can be cut."""

import contextlib
import json
import subprocess
import sys
from pathlib import Path

from skyless.run.gather.address import NatsAddress
from support.processes import free_port

SITE = 7
_PUBLISHED = ("skyless.v1.7.>", "skyless.v2.7.>", "sourced.7.>", "$JSC.R.>", "$JS.R.>", "_R_.>")
_SUBSCRIBED = ("$JS.site7.API.>", "skyless.v1.7.>", "$JS.ACK.>", "$JS.FC.>")


class Servers:
    """The settings and addresses of both."""

    def __init__(self, folder):
        self.folder = folder
        self.ports = {name: free_port() for name in ("hub", "leaf", "site", "mqtt")}
        self.hub = NatsAddress(f"nats://127.0.0.1:{self.ports['hub']}", "op", "op")
        self.site = NatsAddress(f"nats://127.0.0.1:{self.ports['site']}")
        permissions = {"publish": {"allow": _PUBLISHED}, "subscribe": {"allow": _SUBSCRIBED}}
        users = [{"user": "op", "password": "op"}, {"user": "site7", "password": "s", "permissions": permissions}]
        leaf = {"urls": [f"nats://site7:s@127.0.0.1:{self.ports['leaf']}"]}
        self.settings = {
            "hub": {
                "leafnodes": {"listen": f"127.0.0.1:{self.ports['leaf']}", "no_advertise": True},
                "jetstream": {"domain": "hub"},
                "accounts": {"T1": {"jetstream": "enabled", "users": users}},
            },
            "site": {
                "jetstream": {"domain": "site7"},
                "mqtt": {"listen": f"127.0.0.1:{self.ports['mqtt']}"},
                "leafnodes": {"remotes": [leaf | {"deny_imports": ["$MQTT.>"], "deny_exports": ["$MQTT.>"]}]},
            },
        }

    @contextlib.contextmanager
    def running(self, name):
        """One of the servers."""
        settings = {"server_name": name, "listen": f"127.0.0.1:{self.ports[name]}"} | self.settings[name]
        settings["jetstream"] |= {"store_dir": str(self.folder / name), "max_file_store": 1_000_000_000}
        file = self.folder / f"{name}.json"
        file.write_text(json.dumps(settings))
        with subprocess.Popen(
            [Path(sys.executable).with_name("nats-server"), "-c", file], stderr=subprocess.DEVNULL
        ) as process:
            try:
                yield
            finally:
                process.kill()
