"""The commands of a running site."""
