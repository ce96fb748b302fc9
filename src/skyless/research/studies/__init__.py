"""Studies: how accuracy depends on one quantity at a time, in simulation."""
