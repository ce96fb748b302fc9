"""Tags in Home Assistant, over MQTT: announced as devices, with the room that each is in.

Within the package: announcer, discovery, target.
"""
