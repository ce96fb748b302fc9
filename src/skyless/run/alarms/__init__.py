"""Alarms: which rules are raised, for whom, and when they end."""
