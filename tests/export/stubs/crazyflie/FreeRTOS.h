/* The little of FreeRTOS that the example uses, to compile it without the firmware. */
#pragma once
#include <stdint.h>

typedef uint32_t TickType_t;
#define M2T(milliseconds) ((TickType_t)(milliseconds))
