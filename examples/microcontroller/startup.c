/*
 * What runs before main on any Cortex-M: the vector table, and the code that sets up memory.
 */
#include <stdint.h>

#include "board.h"

extern uint32_t stack_top[], data_start[], data_end[], data_in_flash[], bss_start[], bss_end[];
int main(void);
void reset(void);

void reset(void)
{
    uint32_t *to;
    const uint32_t *from = data_in_flash;

    for (to = data_start; to < data_end; to++)
        *to = *from++;
    for (to = bss_start; to < bss_end; to++)
        *to = 0;
#ifdef __ARM_FP /* the FPU is off after a reset: let code use coprocessors 10 and 11 */
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20;
    __asm__ volatile("dsb\n\tisb" ::: "memory");
#endif
    stop(main());
}

static void fault(void)
{
    print("hard fault\n");
    stop(1);
}

/* The first 16 words of flash; without interrupts there are no more. */
__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    (void (*)(void))stack_top, reset, fault, fault, fault, fault, fault, 0, 0, 0, 0, fault,
    fault, 0, fault, fault,
};
