"""``skyless gather``: the fixes of a large site in batches."""

from typing import Annotated

from cyclopts import App, Parameter

from skyless.cli.common import JsonOptions, command, print_json
from skyless.cli.nodes.options import GatherOptions, log, run_until_stopped
from skyless.core.extras import extra_module
from skyless.run.gather.streams import nats_address

app = App(name="gather", help_epilogue="Example: skyless gather --nats nats://127.0.0.1:4222 --site-id 7")


@app.default
@command
def gather(
    *,
    nats: Annotated[str, Parameter(env_var="SKYLESS_NATS")] = "nats://127.0.0.1:4222",
    mqtt: str | None = None,
    asked: GatherOptions,
    output: JsonOptions,
) -> None:
    """Pack the fixes of a site's tags into batches until Ctrl-C, and keep them in a stream of NATS.

    skyless broker --gather runs it. Several gathers of one site share its fixes. At the end it says what was gathered
    and dropped.

    Parameters
    ----------
    nats
        NATS server with JetStream and MQTT, nats://[USER@]HOST[:PORT] or tls://...; the password is taken from
        SKYLESS_MQTT_PASSWORD.
    mqtt
        Broker to copy kept messages from: the same server, mqtt://[USER@]HOST[:PORT]. Zones, plans and the like are
        then in the stream of the site's state from the start, and not from their next change on.
    """
    extra_module("nats", "skyless gather")
    from skyless.run.gather.node import Gather
    from skyless.run.mqtt.address import mqtt_address

    broker = None if mqtt is None else mqtt_address(mqtt)
    node = Gather(nats_address(nats), asked.site_id, round(1e9 * asked.keep_gb), log, broker)
    run_until_stopped(node.run())
    summary = node.summary
    if output.json:
        print_json({"site_id": node.site, "summary": summary})
    else:
        log(
            f"site {node.site}: {summary.fixes} fixes, {summary.batches} batches in the stream, dropped {summary.drops}"
        )
