"""MQTT: topics, messages, connections, access."""
