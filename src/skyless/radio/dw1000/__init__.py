"""DW1000 chips on SPI: the driver in C, and its use from Python."""
