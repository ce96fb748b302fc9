"""MQTT: topics, messages, the link to a broker."""
