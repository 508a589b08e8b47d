/* The parts of the firmware's stabilizer that the example uses, to compile it without the firmware. */
#pragma once
#include <stdbool.h>
#include <stdint.h>

typedef struct {
    float x, y, z;
} vector_t;
typedef struct {
    float x, y, z, w;
} quaternion_t;
typedef enum { modeDisable, modeAbs, modeVelocity } stab_mode_t;
typedef enum { controlModeLegacy, controlModeForceTorque, controlModeForce } control_mode_t;
typedef struct {
    float normalizedForces[4];
    control_mode_t controlMode;
} control_t;
typedef struct {
    vector_t position;
    struct {
        stab_mode_t z;
    } mode;
} setpoint_t;
typedef struct {
    vector_t gyro;
} sensorData_t;
typedef struct {
    quaternion_t attitudeQuaternion;
    vector_t position, velocity;
} state_t;
typedef uint32_t stabilizerStep_t;

#define RATE_MAIN_LOOP 1000
#define RATE_100_HZ 100
#define RATE_DO_EXECUTE(rate, step) ((step) % (RATE_MAIN_LOOP / (rate)) == 0)

void controllerOutOfTreeInit(void);
bool controllerOutOfTreeTest(void);
void controllerOutOfTree(control_t *control, const setpoint_t *setpoint,
                         const sensorData_t *sensors, const state_t *state,
                         const stabilizerStep_t stabilizerStep);
