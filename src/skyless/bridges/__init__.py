"""Bridges: a site's fixes for other programs and devices, each in its own format and over its own transport."""
