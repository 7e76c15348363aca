/* What the firmware does with forces: each is clipped, and becomes a whole number of 65,535 parts. */
#include "power_distribution.h"

void powerDistribution(const control_t *control, motors_thrust_uncapped_t *uncapped)
{
    for (int i = 0; i < STABILIZER_NR_OF_MOTORS; ++i) {
        const float f = control->normalizedForces[i];

        uncapped->list[i] = (f < 0.0f ? 0.0f : f > 1.0f ? 1.0f : f) * UINT16_MAX;
    }
}

bool powerDistributionCap(const motors_thrust_uncapped_t *uncapped, motors_thrust_pwm_t *pwm)
{
    for (int i = 0; i < STABILIZER_NR_OF_MOTORS; ++i) {
        pwm->list[i] = uncapped->list[i];
    }
    return false;
}
