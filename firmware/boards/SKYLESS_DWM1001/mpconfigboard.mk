MCU_SERIES = m4
MCU_VARIANT = nrf52
MCU_SUB_VARIANT = nrf52832
LD_FILES += boards/nrf52832_512k_64k.ld

NRF_DEFINES += -DNRF52832_XXAA

MICROPY_VFS_LFS2 = 1

FROZEN_MANIFEST ?= $(BOARD_DIR)/manifest.py

# The loops over bytes are machine code.
MPY_CROSS_FLAGS += -march=armv7m
