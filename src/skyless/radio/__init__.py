"""Radios: boards on a serial port, DW1000 chips on SPI, the emulated air, and devices of other makers."""
