"""Runs in Home Assistant's own environment: a real core, whose states it prints as lines of JSON.

``home_assistant_driver.py FOLDER BROKER_PORT [USER]``. The first start adds the MQTT integration; it ends by SIGTERM.
Where a user is named, it is made, and what a browser needs to be it is printed.
"""

import asyncio
import json
import signal
import sys

from homeassistant import bootstrap, runner
from homeassistant.helpers import entity_registry

WATCHED = ("sensor", "binary_sensor", "device_tracker")


def show(line):
    sys.stdout.write(json.dumps(line) + "\n")
    sys.stdout.flush()


def state_of(hass, state):
    entry = entity_registry.async_get(hass).async_get(state.entity_id)
    return {
        "device": entry.device_id if entry else None,
        "entity": state.entity_id,
        "unique_id": entry.unique_id if entry else None,
        "state": state.state,
        "attributes": {key: value for key, value in state.attributes.items() if isinstance(value, str | int | float)},
    }


async def access_of(hass, name):
    """What Home Assistant's page keeps in a browser."""
    user = await hass.auth.async_create_user(name, group_ids=["system-admin"])
    client = f"http://127.0.0.1:{hass.http.server_port}/"
    token = await hass.auth.async_create_refresh_token(user, client)
    access = {
        "access_token": hass.auth.async_create_access_token(token),
        "token_type": "Bearer",
        "expires_in": 1800,
        "hassUrl": client.rstrip("/"),
        "clientId": client,
        "expires": 4102444800000,
        "refresh_token": token.token,
    }
    return {"access": access}


async def main(folder, port, user=None):
    hass = await bootstrap.async_setup_hass(
        runner.RuntimeConfig(config_dir=folder, skip_pip=True, skip_pip_packages=[], recovery_mode=False)
    )
    assert hass is not None and not hass.config.recovery_mode, "Home Assistant has not started"
    await hass.async_start()

    def changed(event):
        state = event.data["new_state"]
        if event.data["entity_id"].split(".")[0] in WATCHED:
            line = {"entity": event.data["entity_id"], "state": None} if state is None else state_of(hass, state)
            show(line)

    hass.bus.async_listen("state_changed", changed)
    if not hass.config_entries.async_entries("mqtt"):
        flow = await hass.config_entries.flow.async_init("mqtt", context={"source": "user"})
        result = await hass.config_entries.flow.async_configure(
            flow["flow_id"], {"broker": "127.0.0.1", "port": int(port)}
        )
        assert result["type"] == "create_entry", result
    for state in hass.states.async_all(WATCHED):
        show(state_of(hass, state))
    if user is not None:
        show(await access_of(hass, user))
    show({"ready": True})
    ended = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, ended.set)
    await ended.wait()
    await hass.async_stop()


asyncio.run(main(*sys.argv[1:]))
