// The DWM1001 module: nRF52832 with a DW1000.

#define MICROPY_HW_BOARD_NAME "DWM1001 of Skyless"
#define MICROPY_HW_MCU_NAME "NRF52832"
#define MICROPY_PY_SYS_PLATFORM "nrf52"

// More of the language than the port gives this processor (slices, bytearray, files), and what frozen machine code
// (viper) needs: without a SoftDevice there is room for both.
#define MICROPY_CONFIG_ROM_LEVEL (MICROPY_CONFIG_ROM_LEVEL_CORE_FEATURES)
#define MICROPY_EMIT_THUMB (1)
#define MICROPY_EMIT_INLINE_THUMB (1)

#define MICROPY_PY_MACHINE_UART (1)
#define MICROPY_PY_TIME_TICKS (1)
#define MICROPY_HW_ENABLE_RNG (1)
#define MICROPY_HW_HAS_LED (0)

// The port's own console until main.py takes the pins: UART 0, wired to the J-Link of a DWM1001-DEV.
#define MICROPY_HW_UART1_TX (5)
#define MICROPY_HW_UART1_RX (11)
#define MICROPY_HW_UART1_HWFC (0)

#define MICROPY_HW_SPI0_NAME "SPI0"
#define MICROPY_HW_SPI0_SCK (16)
#define MICROPY_HW_SPI0_MOSI (20)
#define MICROPY_HW_SPI0_MISO (18)
