"""Radios in an emulated ether, over TCP."""
