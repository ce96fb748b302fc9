"""Experiments: runs of the machines in the simulated world and over recordings, judged against the truth."""
