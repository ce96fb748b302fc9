"""Radios: boards on serial ports, DW1000 chips on SPI, the emulated air, and devices of other makers."""
