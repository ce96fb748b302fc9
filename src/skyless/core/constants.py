"""Physical and radio constants, each with its source."""

from typing import Final

SPEED_OF_LIGHT_MPS: Final = 299_792_458.0
"""Speed of light in vacuum, exact (SI). Air slows it by 0.03 %, 1.6 mm over 6 m, and a calibration absorbs it."""

CHIP_RATE_HZ: Final = 499.2e6
"""Chipping rate of the IEEE 802.15.4 HRP UWB PHY (802.15.4-2015, 16.2)."""

TICK_RATE_HZ: Final = 128 * CHIP_RATE_HZ
"""Rate of the DW1000's timestamp counter, 63.8976 GHz (DW1000 User Manual v2.12, 7.2.8)."""

TICK_S: Final = 1.0 / TICK_RATE_HZ
"""One tick of the timestamp counter, 15.650040064 ps."""

TICK_M: Final = SPEED_OF_LIGHT_MPS * TICK_S
"""What light travels in one tick, 4.692 mm."""

TICK_BITS: Final = 40
"""Width of the timestamp counter (DW1000 User Manual v2.12, 7.2.8); it wraps every 17.2074 s."""

SUBTICKS: Final = 256
"""Parts of a tick; the air's unit of the site's time, of which beacons carry 48 bits."""

DELAYED_TX_GRANULARITY_TICKS: Final = 512
"""DX_TIME ignores its low nine bits: transmissions start on 8.013 ns boundaries (DW1000 User Manual, p. 26)."""

DEFAULT_ANTENNA_DELAY_TICKS: Final = 16_436
"""Common default of TX_ANTD and LDE_RXANTD at 64 MHz PRF (DW1000 User Manual v2.12, 7.2.25)."""

MAX_DRIFT: Final = 50e-6
"""Two clocks cannot drift apart faster: each within 20 ppm (IEEE 802.15.4-2015, 16.4.9), and room for motion."""

CARRIER_CYCLES: Final = {1: 7, 2: 8, 3: 9, 4: 8, 5: 13, 7: 13}
"""Cycles of each channel's carrier in 128 ticks: the centre frequencies over half the chipping rate (table 16-3)."""

CHANNEL_5_HZ: Final = 6489.6e6
"""Centre frequency of channel 5 (IEEE 802.15.4-2015, table 16-3)."""
