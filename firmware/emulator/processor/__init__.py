"""An nRF52832 with a DW1000 on its SPI: the core on Unicorn, its peripherals, what instructions cost."""
