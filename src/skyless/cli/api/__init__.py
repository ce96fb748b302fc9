"""Commands as Python functions."""
