"""Radios on boards behind a serial port."""
