"""Radios on boards behind a serial port.

Public: foreign_radios, link, link_records, pseudo_terminal, serial_port, serial_radio.
"""
