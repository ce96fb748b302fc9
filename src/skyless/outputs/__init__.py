"""What Skyless tells others: MQTT topics and messages, and the link that carries them."""
