"""What a DWM1001 does when it starts: an anchor's radio, or a tag's, which only listens.

It is a tag's where the file ``role.txt`` begins with ``tag``, or without such a file where pin ROLE is tied to ground.
Whatever goes wrong ends in a reset, as there is no place for an error message: the serial port carries the link.
"""

import gc
import time

import board
import dw1000
import link
import machine
import nrf52
from machine import SPI, Pin

DEVICE_ID = 0x1000_0060
"""FICR.DEVICEID, 8 bytes: the port's ``machine.unique_id`` may be empty."""


def can_transmit() -> bool:
    """Whether this is an anchor."""
    try:
        with open("role.txt") as file:  # noqa: PTH123 - MicroPython
            return file.read(3) != "tag"
    except OSError:
        return bool(Pin("ROLE", Pin.IN, Pin.PULL_UP).value())


def main() -> None:
    """Set up pins and buses, and serve until the power goes."""
    Pin("UART_TX", Pin.OUT, value=1)
    Pin("UART_RX", Pin.IN, Pin.PULL_UP)
    select = Pin("DW_CS", Pin.OUT, value=1)
    interrupt = Pin("DW_IRQ", Pin.IN, Pin.PULL_DOWN)
    bus = nrf52.SpiBus(SPI(1, baudrate=nrf52.SLOW_HZ), select, Pin("DW_RST", Pin.IN), time.sleep_us)
    uart = nrf52.Uarte(time.sleep_us)
    identity = bytearray(8)
    link.copy(DEVICE_ID, 0, 8, identity, 0)  # machine code treats a number as an address
    made = board.Board(dw1000.DW1000(bus), uart, time, gc, can_transmit(), identity, interrupt)
    gc.collect()
    made.begin()
    while True:
        made.turn()


try:
    main()
finally:
    machine.reset()
