"""``skyless gather``: the fixes of a large site in batches."""

import contextlib
from typing import Annotated

from cyclopts import App, Parameter

from skyless.cli.common.options import command
from skyless.cli.common.output import print_json
from skyless.cli.nodes.options import USUAL_KEEP_GB, KeepGb, SiteId, log

app = App(name="gather", help_epilogue="Example: skyless gather --nats nats://127.0.0.1:4222 --site-id 7")


@app.default
@command
def gather(
    *,
    nats: Annotated[str, Parameter(env_var="SKYLESS_NATS")] = "nats://127.0.0.1:4222",
    site_id: SiteId | None = None,
    keep_gb: KeepGb = USUAL_KEEP_GB,
    json: bool = False,
) -> None:
    """Pack the fixes of a site's tags into batches until Ctrl-C, and keep them in a stream of NATS.

    skyless broker --gather runs it. Several gathers of one site share its fixes.

    Parameters
    ----------
    nats
        NATS server with JetStream and MQTT, nats://[USER@]HOST[:PORT] or tls://...; the password is taken from
        SKYLESS_MQTT_PASSWORD.
    site_id
        Number of the site that is gathered; by default the first one of which anything is heard.
    keep_gb
        Gigabytes of fixes that the broker keeps for readers that come later, at most those of 24 hours.
    json
        Write one JSON object at the end: what was gathered and dropped.
    """
    from skyless.core.extras import extra_module
    from skyless.run.gather.address import nats_address
    from skyless.run.process import run

    extra_module("nats", "skyless gather")
    from skyless.run.gather.node import Gather

    node = Gather(nats_address(nats), site_id, round(1e9 * keep_gb), log)
    with contextlib.suppress(KeyboardInterrupt):
        run(node.run())
    summary = node.summary
    if json:
        print_json({"site_id": node.site, "summary": summary})
    else:
        log(
            f"site {node.site}: {summary.fixes} fixes, {summary.batches} batches in the stream, dropped {summary.drops}"
        )
