#pragma once

int consolePrintf(const char *format, ...) __attribute__((format(printf, 1, 2)));
#define DEBUG_PRINT(format, ...) consolePrintf(DEBUG_MODULE ": " format, ##__VA_ARGS__)
