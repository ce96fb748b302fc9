"""The protocol machine of an anchor of protocol 2."""
