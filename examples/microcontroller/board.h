/*
 * All that the program needs of a board. Here it is semihosting, by which QEMU or a debugger prints
 * text; on a board of your own, write print() for its serial port.
 */
#ifndef BOARD_H
#define BOARD_H

#include <stdint.h>

/* Write a text. */
void print(const char *text);

/* End the program; 0 means success. */
__attribute__((noreturn)) void stop(int code);

/* Start the timer that ticks() reads: SysTick, which counts down from 2^24 - 1. */
void start_ticks(void);

/* The timer's value. */
uint32_t ticks(void);

/* Whether the timer has reached 0 since start_ticks(), after 2^24 - 1 ticks. */
int ran_out(void);

#endif
