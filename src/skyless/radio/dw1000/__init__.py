"""A DW1000 on SPI: the driver in C and its use from Python."""
