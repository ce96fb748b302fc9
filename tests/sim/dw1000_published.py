"""Registers of the DW1000, typed from a published source: a third table, against which driver and model are held.

Zephyr, drivers/ieee802154/ieee802154_dw1000_regs.h (Apache 2.0; from Decawave's mynewt-dw1000-core), at commit
0c3cce8c, read on 20 November 2026. Names are the manual's. It departs from the manual v2.12 in three places: AGC_TUNE3
is 0x0055 there (and 0x0035 in the manual's table 26 and in Bitcraze's libdw1000), FS_PLLCFG has five octets there (four
in 7.2.44: the fifth would be FS_PLLTUNE), and the mask of RCPHASE lies behind the end of RX_TTCKO (the manual has it in
its last octet).
"""

REGISTERS = {
    # name: file, sub-address, octets
    "DEV_ID": (0x00, 0x00, 4),
    "EUI": (0x01, 0x00, 8),
    "PANADR": (0x03, 0x00, 4),
    "SYS_CFG": (0x04, 0x00, 4),
    "SYS_TIME": (0x06, 0x00, 5),
    "TX_FCTRL": (0x08, 0x00, 5),
    "TX_BUFFER": (0x09, 0x00, 1024),
    "DX_TIME": (0x0A, 0x00, 5),
    "RX_FWTO": (0x0C, 0x00, 2),
    "SYS_CTRL": (0x0D, 0x00, 4),
    "SYS_MASK": (0x0E, 0x00, 4),
    "SYS_STATUS": (0x0F, 0x00, 5),
    "RX_FINFO": (0x10, 0x00, 4),
    "RX_BUFFER": (0x11, 0x00, 1024),
    "RX_FQUAL": (0x12, 0x00, 8),
    "RX_TTCKI": (0x13, 0x00, 4),
    "RX_TTCKO": (0x14, 0x00, 5),
    "RX_TIME": (0x15, 0x00, 14),
    "RX_STAMP": (0x15, 0x00, 5),
    "RX_RAWST": (0x15, 0x09, 5),
    "TX_TIME": (0x17, 0x00, 10),
    "TX_STAMP": (0x17, 0x00, 5),
    "TX_RAWST": (0x17, 0x05, 5),
    "TX_ANTD": (0x18, 0x00, 2),
    "SYS_STATE": (0x19, 0x00, 5),
    "ACK_RESP_T": (0x1A, 0x00, 4),
    "RX_SNIFF": (0x1D, 0x00, 4),
    "TX_POWER": (0x1E, 0x00, 4),
    "CHAN_CTRL": (0x1F, 0x00, 4),
    "USR_SFD": (0x21, 0x00, 41),
    "AGC_CTRL1": (0x23, 0x02, 2),
    "AGC_TUNE1": (0x23, 0x04, 2),
    "AGC_TUNE2": (0x23, 0x0C, 4),
    "EC_CTRL": (0x24, 0x00, 4),
    "ACC_MEM": (0x25, 0x00, 4064),
    "GPIO_CTRL": (0x26, 0x00, 44),
    "DRX_TUNE0B": (0x27, 0x02, 2),
    "DRX_TUNE1A": (0x27, 0x04, 2),
    "DRX_TUNE1B": (0x27, 0x06, 2),
    "DRX_TUNE2": (0x27, 0x08, 4),
    "DRX_SFDTOC": (0x27, 0x20, 2),
    "DRX_PRETOC": (0x27, 0x24, 2),
    "DRX_TUNE4H": (0x27, 0x26, 2),
    "DRX_CAR_INT": (0x27, 0x28, 3),
    "RXPACC_NOSAT": (0x27, 0x2C, 2),
    "RF_CONF": (0x28, 0x00, 58),
    "RF_RXCTRLH": (0x28, 0x0B, 1),
    "RF_TXCTRL": (0x28, 0x0C, 4),
    "TC_PGDELAY": (0x2A, 0x0B, 1),
    "TC_PGTEST": (0x2A, 0x0C, 1),
    "FS_PLLTUNE": (0x2B, 0x0B, 1),
    "FS_XTALT": (0x2B, 0x0E, 1),
    "AON_WCFG": (0x2C, 0x00, 2),
    "AON_CTRL": (0x2C, 0x02, 1),
    "AON_CFG0": (0x2C, 0x06, 4),
    "AON_CFG1": (0x2C, 0x0A, 2),
    "OTP_ADDR": (0x2D, 0x04, 2),
    "OTP_CTRL": (0x2D, 0x06, 2),
    "OTP_RDAT": (0x2D, 0x0A, 4),
    "OTP_SF": (0x2D, 0x12, 1),
    "LDE_THRESH": (0x2E, 0x0000, 2),
    "LDE_CFG1": (0x2E, 0x0806, 1),
    "LDE_PPINDX": (0x2E, 0x1000, 2),
    "LDE_PPAMPL": (0x2E, 0x1002, 2),
    "LDE_RXANTD": (0x2E, 0x1804, 2),
    "LDE_CFG2": (0x2E, 0x1806, 2),
    "LDE_REPC": (0x2E, 0x2804, 2),
    "PMSC_CTRL0": (0x36, 0x00, 4),
    "PMSC_CTRL1": (0x36, 0x04, 4),
    "PMSC_LEDC": (0x36, 0x28, 4),
    # offsets alone are told there; octets from the manual
    "FP_INDEX": (0x15, 0x05, 2),
    "FP_AMPL1": (0x15, 0x07, 2),
    "RF_STATUS": (0x28, 0x2C, 4),
    "TC_SARC": (0x2A, 0x00, 2),
    "TC_SARW": (0x2A, 0x06, 2),
    "FS_PLLCFG": (0x2B, 0x07, 4),
}

STATUS_BITS = (
    "IRQS CPLOCK ESYNCR AAT TXFRB TXPRS TXPHS TXFRS RXPRD RXSFDD LDEDONE RXPHD "
    "RXPHE RXDFR RXFCG RXFCE RXRFSL RXRFTO LDEERR - RXOVRR RXPTO GPIOIRQ SLP2INIT "
    "RFPLL_LL CLKPLL_LL RXSFDTO HPDWARN TXBERR AFFREJ HSRBP ICRBP RXRSCS RXPREJ TXPUTE"
)
STATUS = {name: 1 << bit for bit, name in enumerate(STATUS_BITS.split()) if name != "-"}
CONTROL = {
    "SFCST": 0x00000001,
    "TXSTRT": 0x00000002,
    "TXDLYS": 0x00000004,
    "CANSFCS": 0x00000008,
    "TRXOFF": 0x00000040,
    "WAIT4RESP": 0x00000080,
    "RXENAB": 0x00000100,
    "RXDLYE": 0x00000200,
    "HRBPT": 0x01000000,
}
CONFIG = {
    "HIRQ_POL": 0x00000200,
    "DIS_DRXB": 0x00001000,
    "PHR_MODE": 0x00030000,
    "RXM110K": 0x00400000,
    "RXWTOE": 0x10000000,
    "RXAUTR": 0x20000000,
}
OTHER_BITS = {
    "LDERUNE": 0x00020000,
    "OTPRDEN": 0x0001,
    "OTPREAD": 0x0002,
    "LDELOAD": 0x8000,
    "SYSCLKS_XTI": 0x1,
    "FACE": 0x40,
    "AMCE": 0x8000,  # within the access mask there; Decawave's driver switches it on together with FACE
}

VALUES = {
    # channel 5, PRF 64 MHz, 6.8 Mbit/s, standard SFD, preamble of 128, PAC 8, code 9
    "AGC_TUNE1": 0x889B,
    "AGC_TUNE2": 0x2502A907,
    "AGC_TUNE3": 0x0035,  # the manual's; see above
    "DRX_TUNE0B": 0x0001,
    "DRX_TUNE1A": 0x008D,
    "DRX_TUNE1B": 0x0020,
    "DRX_TUNE2": 0x313B006B,
    "DRX_TUNE4H": 0x0028,
    "RF_RXCTRLH": 0xD8,
    "RF_TXCTRL": 0x001E3FE0,
    "TC_PGDELAY": 0xC0,
    "FS_PLLCFG": 0x0800041D,
    "FS_PLLTUNE": 0xBE,
    "LDE_CFG1": 3 << 5 | 13,
    "LDE_CFG2": 0x0607,
    "LDE_REPC": 0x28F4,
    "TX_POWER": 0x25456585,
    "CHAN_CTRL": 5 | 5 << 4 | 0x00080000 | 9 << 22 | 9 << 27,
    "SYS_CFG": 0x00000200 | 0x00001000,
}
TX_FCTRL = 0x00004000 | 0x00008000 | 0x00020000 | 0x00140000  # 6.8 Mbit/s, ranging, PRF 64, 128 symbols
DEVICE_ID = 0xDECA0130
OTP = {"LDOTUNE": 0x04, "PART_ID": 0x06, "LOT_ID": 0x07, "VOLTAGE": 0x08, "TEMPERATURE": 0x09, "CRYSTAL_TRIM": 0x1E}
RESETS = {"ALL": 0x00, "RX": 0xE0, "NONE": 0xF0}  # octet 3 of PMSC_CTRL0
POWER_A_DB = 121.74  # PRF 64

# What two drivers, which have run on many boards, write before they receive and send (channel 5, PRF 64 MHz, code 9,
# 6.8 Mbit/s, 128 symbols): file:sub and the value, whose digits say how many octets. Read on 30 November 2026.
WRITTEN = {
    # Decawave/uwb-dw1000 (Mynewt; DWM1001-DEV), dw1000_phy.c at 861c51a2, dw1000_mac.c at 46fc9d69, dw1000_regs.h at
    # 7ecee2ff: AGC_TUNE3 stays unset, and a transmission is begun and aborted
    "uwb-dw1000": """
        36:00 01  24:00 04  2B:0E 71  36:00 01  36:01 03  2D:06 8000  36:00 00  2A:0B C0  04:00 00001200  2E:2804 28F4
        2E:0806 6D  2E:1806 0607  2B:07 0800041D  2B:0B BE  28:0B D8  28:0C 001E3FE3  27:02 0001  27:04 008D  27:06 0020
        27:26 0028  27:08 313B006B  27:20 0081  23:0C 2502A907  23:04 889B  1F:00 4A480055  08:00 00164000  0D:00 42
    """,
    # thotro/arduino-dw1000, src/DW1000.cpp at 03efdc67, and after it Bitcraze's libdw1000, at 0ab038d1: FS_PLLTUNE of
    # an older manual
    "arduino-dw1000": """
        0D:00 00000040  36:00 F0300301  2D:06 8000  36:00 F0300200  03:00 000A0006  04:00 20001200  1F:00 4A480055
        08:00 000016400C  0E:00 00026080  23:04 889B  23:0C 2502A907  23:12 0035  27:02 0001  27:04 008D  27:06 0020
        27:08 313B006B  27:26 0028  2E:0806 0D  2E:1806 0607  2E:2804 28F4  1E:00 25456585  28:0B D8  28:0C 001E3FE0
        2A:0B C0  2B:0B A6  2B:07 0800041D  18:00 4000  2E:1804 4000
    """,
}
