"""A model of the DW1000: registers, transceiver, clocks."""
