"""Clocks: the paper's model and two-message synchronisation, and the two-state clock filter."""
