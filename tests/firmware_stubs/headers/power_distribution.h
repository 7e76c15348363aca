#pragma once
#include "stabilizer_types.h"
void powerDistribution(const control_t *control, motors_thrust_uncapped_t *uncapped);
bool powerDistributionCap(const motors_thrust_uncapped_t *uncapped, motors_thrust_pwm_t *pwm);
