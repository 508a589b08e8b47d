// The little of Arduino's core that the sketch uses, to compile it without the core.
#pragma once
#include <stdint.h>

enum { INPUT, OUTPUT };
enum { A0 = 14, A1, A2 };
void setup();
void loop();
void pinMode(uint8_t pin, uint8_t mode);
int analogRead(uint8_t pin);
void analogWrite(uint8_t pin, int value);
unsigned long micros();

struct SerialPort {
    void begin(unsigned long baud);
    void println(unsigned long number);
};
extern SerialPort Serial;
