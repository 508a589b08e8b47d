// Steps a policy on the analog inputs and sets PWM outputs by it.
#include "policy.h"  // has extern "C": the sketch is C++, policy.c stays C

#if defined(SB3_SPARSE_VALUE_SIZE) || defined(SB3_SPARSE_MEAN_SIZE) || \
    defined(SB3_SPARSE_LOGITS_SIZE)
#error "export policy.c without --with-value and --stochastic, or pass an array for each output"
#endif

static const uint8_t INPUTS[] = {A0, A1, A2};
static const uint8_t OUTPUTS[] = {9};

static_assert(sizeof INPUTS == SB3_SPARSE_OBSERVATION_SIZE, "an input for each observation");
static_assert(sizeof OUTPUTS == SB3_SPARSE_ACTION_SIZE, "an output for each action");

void setup()
{
    Serial.begin(115200);
    for (uint8_t pin : OUTPUTS)
        pinMode(pin, OUTPUT);
}

void loop()
{
    float obs[SB3_SPARSE_OBSERVATION_SIZE], action[SB3_SPARSE_ACTION_SIZE];

    for (uint8_t i = 0; i < sizeof INPUTS; i++)
        obs[i] = analogRead(INPUTS[i]) / 511.5f - 1.0f;  // in the units of training
    const uint32_t start = micros();
    sb3_sparse_policy(obs, action);
    Serial.println(micros() - start);
    for (uint8_t i = 0; i < sizeof OUTPUTS; i++)
        analogWrite(OUTPUTS[i], static_cast<int>(127.5f * (action[i] + 1.0f)));
}
