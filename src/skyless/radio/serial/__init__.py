"""Boards on serial ports."""
