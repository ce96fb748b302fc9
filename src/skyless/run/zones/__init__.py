"""Zones: where tags enter and leave."""
