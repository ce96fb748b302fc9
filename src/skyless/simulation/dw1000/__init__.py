"""A register-level model of the DW1000 behind its SPI, on the emulated air.

Public: chip, transceiver.
Within the package: clocking, memory, registers, settings.
"""
