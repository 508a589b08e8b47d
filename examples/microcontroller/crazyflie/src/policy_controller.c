/*
 * A controller of the Crazyflie that lives outside the firmware's tree: a policy that sees the
 * error of the position, the attitude, the velocity and the rates, and sets the motors' forces.
 */
#include <stdbool.h>
#include <stdint.h>

#include "FreeRTOS.h"
#include "app.h"
#include "controller.h"
#include "policy.h"
#include "task.h"

#define DEBUG_MODULE "POLICY"
#include "debug.h"

#if defined(SB3_SPARSE_VALUE_SIZE) || defined(SB3_SPARSE_MEAN_SIZE) || \
    defined(SB3_SPARSE_LOGITS_SIZE)
#error "export policy.c without --with-value and --stochastic, or pass an array for each output"
#endif

_Static_assert(SB3_SPARSE_OBSERVATION_SIZE == 13, "position 3, attitude 4, velocity 3, rates 3");
_Static_assert(SB3_SPARSE_ACTION_SIZE == 4, "a force for each motor");

static const float RADIANS = 3.14159265f / 180.0f;

void appMain(void)
{
    DEBUG_PRINT("the policy controls the motors\n");
    for (;;)
        vTaskDelay(M2T(1000)); /* the stabilizer's task does the work */
}

void controllerOutOfTreeInit(void)
{
}

bool controllerOutOfTreeTest(void)
{
    return true;
}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint,
                         const sensorData_t *sensors, const state_t *state,
                         const stabilizerStep_t stabilizerStep)
{
    /* In the order and in the units of training. */
    const float obs[SB3_SPARSE_OBSERVATION_SIZE] = {
        state->position.x - setpoint->position.x,
        state->position.y - setpoint->position.y,
        state->position.z - setpoint->position.z,
        state->attitudeQuaternion.x,
        state->attitudeQuaternion.y,
        state->attitudeQuaternion.z,
        state->attitudeQuaternion.w,
        state->velocity.x,
        state->velocity.y,
        state->velocity.z,
        sensors->gyro.x * RADIANS,
        sensors->gyro.y * RADIANS,
        sensors->gyro.z * RADIANS,
    };
    float action[SB3_SPARSE_ACTION_SIZE];
    int i;

    control->controlMode = controlModeForce;
    if (setpoint->mode.z == modeDisable) { /* nobody asks it to fly */
        for (i = 0; i < SB3_SPARSE_ACTION_SIZE; i++)
            control->normalizedForces[i] = 0.0f;
    } else if (RATE_DO_EXECUTE(RATE_100_HZ, stabilizerStep)) { /* between: the last forces */
        sb3_sparse_policy(obs, action);
        for (i = 0; i < SB3_SPARSE_ACTION_SIZE; i++)
            control->normalizedForces[i] = 0.5f * (action[i] + 1.0f); /* actions in [-1, 1] */
    }
}
