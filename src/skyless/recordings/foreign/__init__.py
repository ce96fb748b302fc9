"""Recordings of other systems: their formats as streams of packets or time differences."""
