#include "board.h"

enum { WRITE_TEXT = 0x04, EXIT_WITH_CODE = 0x20 };
static const uint32_t APPLICATION_EXIT = 0x20026u;
static volatile uint32_t *const SYSTICK = (volatile uint32_t *)0xE000E010u;

static void semihosting(uint32_t operation, const void *argument)
{
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;

    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

void print(const char *text)
{
    semihosting(WRITE_TEXT, text);
}

void stop(int code)
{
    const uint32_t reason[2] = {APPLICATION_EXIT, (uint32_t)code};

    semihosting(EXIT_WITH_CODE, reason);
    for (;;)
        ;
}

void start_ticks(void)
{
    SYSTICK[1] = 0xFFFFFFu; /* restart from here after 0 */
    SYSTICK[2] = 0;         /* begin there now */
    SYSTICK[0] = 5u;        /* on, at the processor's clock, without an interrupt */
}

uint32_t ticks(void)
{
    return SYSTICK[2];
}

int ran_out(void)
{
    return (SYSTICK[0] >> 16) & 1u; /* COUNTFLAG, which start_ticks() has cleared */
}
