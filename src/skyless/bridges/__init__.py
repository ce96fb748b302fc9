"""A site's fixes for other programs and devices, each in its own protocol."""
