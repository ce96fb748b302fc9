/* Wiring of the DWM1001 module (DWM1001 data sheet, table 1), and of the lights of the DWM1001-DEV. */
#ifndef PINS_H
#define PINS_H

#define PIN_UART_TX 5u
#define PIN_UART_RX 11u
#define PIN_ROLE 13u /* to ground: only listens */
#define PIN_CHIP_SCK 16u
#define PIN_CHIP_SELECT 17u
#define PIN_CHIP_MISO 18u
#define PIN_CHIP_IRQ 19u
#define PIN_CHIP_MOSI 20u
#define PIN_CHIP_RESET 24u
#define PIN_AWAKE 15u /* free; high while the processor is awake, for an oscilloscope */

/* On the DWM1001-DEV only, lit when low */
#define PIN_LIGHT_READY 30u    /* green */
#define PIN_LIGHT_RECEIVED 31u /* blue */
#define PIN_LIGHT_SENT 22u     /* red */
#define PIN_LIGHT_FAULT 14u    /* red */

#endif
