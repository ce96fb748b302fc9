"""The MQTT broker that comes with Skyless."""
