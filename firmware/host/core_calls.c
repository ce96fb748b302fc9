/* The core on the chip without a radio: what runs the image writes a call into RAM, and ends the processor's sleep. */
#include "nrf52832.h"
#include "skyless_core.h"

extern State core_state;
extern Packet core_packet;
extern Relays core_relays;
extern volatile int32_t core_outcome;

State core_state;
Packet core_packet;
Relays core_relays;
volatile int32_t core_outcome;

int main(void);

int main(void)
{
    NVMC_ICACHECNF = 1u;
    for (;;) {
        __asm volatile("wfi" ::: "memory");
        core_outcome = skyless_process_frame(&core_state, &core_packet, &core_relays, 0, 0);
    }
}
