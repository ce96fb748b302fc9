"""The survey of a running site."""
