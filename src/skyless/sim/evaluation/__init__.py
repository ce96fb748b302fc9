"""Fleets of tags in the simulated world, and how their fixes are judged."""
