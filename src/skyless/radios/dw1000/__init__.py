"""A DW1000 on SPI, or a model of one.

Public: model, radio, spi.
Within the package: driver.
"""
