"""Recordings of running sites, in MCAP."""
