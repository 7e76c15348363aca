/* An app as the firmware's loop calls it, for many vehicles in turn. Compiled as a library for ctypes, or as a program that reads in.bin. */
#include <stdio.h>
#include <stdlib.h>

#include "sb3quad.c"

#include "power_distribution.h"

#ifdef __arm__
/* QEMU's timer 2 counts nanoseconds, and with -icount shift=0 an instruction takes one. */
#define TIM2(offset) (*(volatile uint32_t *)(0x40000000 + (offset)))
#else
static uint32_t nothing[16];
#define TIM2(offset) nothing[(offset) / 4]
#endif

/* One control step of one vehicle. */
typedef struct {
    float position[3], quaternion[4], velocity[3], gyro[3];
    float target[3], speed[3], acceleration[3], yaw, yaw_rate;
} row;

static long pid_calls, pid_resets;
static uint32_t longest;

void vTaskDelay(uint32_t ticks) { exit((int)ticks); }
uint64_t usecTimestamp(void) { return 0; }

/* OWN_PID: the firmware's own one is linked. */
#ifndef OWN_PID
void controllerPidInit(void) {}
bool controllerPidTest(void) { return true; }
void controllerPid(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors, const state_t *state, const stabilizerStep_t stabilizerStep)
{
    (void)sensors, (void)state, (void)stabilizerStep;
    ++pid_calls;
    pid_resets += setpoint->mode.x == modeDisable && setpoint->mode.roll == modeDisable;
    control->controlMode = controlModeLegacy;
}
#endif

long app_count(int resets) { return resets ? pid_resets : pid_calls; }
int app_size(void) { return (int)sizeof app; }
float app_thrust_max(void) { return THRUST_MAX; }
float app_thrust_min(void) { return THRUST_MIN; }

/* Call the controller PERIOD times with the same state. Motors: thrusts of the first and of the last call, N; -1 under a PID that is ours. */
static void control_step(const row *in, int fly, const int mode[7], int velocity_body, float motors[2][4])
{
    static stabilizerStep_t steps;
    const setpoint_t setpoint = {
        .position = {0, in->target[0], in->target[1], in->target[2]},
        .velocity = {0, in->speed[0], in->speed[1], in->speed[2]},
        .acceleration = {0, in->acceleration[0], in->acceleration[1], in->acceleration[2]},
        .attitude = {0, 0.0f, 0.0f, in->yaw},
        /* The same heading once more, for setpoints that have a quaternion. */
        .attitudeQuaternion = {.x = 0.0f, .y = 0.0f, .z = sinf(0.0087266463f * in->yaw), .w = cosf(0.0087266463f * in->yaw)},
        .attitudeRate = {0, 0.0f, 0.0f, in->yaw_rate},
        .velocity_body = velocity_body,
        .mode = {mode[0], mode[1], mode[2], mode[3], mode[4], mode[5], mode[6]}};
    const sensorData_t sensors = {.gyro = {.x = in->gyro[0], .y = in->gyro[1], .z = in->gyro[2]}};
    const state_t state = {
        .attitudeQuaternion = {.x = in->quaternion[0], .y = in->quaternion[1], .z = in->quaternion[2], .w = in->quaternion[3]},
        .position = {0, in->position[0], in->position[1], in->position[2]},
        .velocity = {0, in->velocity[0], in->velocity[1], in->velocity[2]}};

    app.fly = fly;
    for (int call = 0; call < PERIOD; ++call) {
        control_t control;
        motors_thrust_uncapped_t uncapped;
        motors_thrust_pwm_t pwm;
        const uint32_t start = TIM2(0x24);

        controllerOutOfTree(&control, &setpoint, &sensors, &state, ++steps);
        longest = TIM2(0x24) - start > longest ? TIM2(0x24) - start : longest;
        powerDistribution(&control, &uncapped);
        powerDistributionCap(&uncapped, &pwm);
        for (int i = 0; i < 4; ++i) {
            float *motor = &motors[call > 0][i];

            *motor = pwm.list[i] / 65535.0f * THRUST_MAX;
#ifndef OWN_PID
            *motor = control.controlMode == controlModeForce ? *motor : -1.0f;
#endif
        }
    }
}

/* Vehicles in turn, each with the variables of its own app. */
void app_run(const row *in, int fly, const int mode[7], int velocity_body, char *apps, float motors[][2][4], long n)
{
    for (long k = 0; k < n; ++k) {
        memcpy(&app, apps + k * (long)sizeof app, sizeof app);
        control_step(in + k, fly, mode, velocity_body, motors[k]);
        memcpy(apps + k * (long)sizeof app, &app, sizeof app);
    }
}

int main(void)
{
    static const int position[7] = {modeAbs, modeAbs, modeAbs, modeDisable, modeDisable, modeAbs, modeDisable};
    FILE *in = fopen("in.bin", "rb"), *out = fopen("out.bin", "wb");
    row observed;
    float motors[2][4];
    uint64_t sum = 0;
    long calls = 0;

    TIM2(0x00) = 1;
    controllerOutOfTreeInit();
    while (fread(&observed, sizeof observed, 1, in) == 1) {
        const uint32_t start = TIM2(0x24);

        control_step(&observed, 1, position, 0, motors);
        sum += TIM2(0x24) - start;
        ++calls;
        fwrite(app.force, sizeof app.force, 1, out);
    }
    printf("%ld %.1f %lu\n", calls, (double)sum / calls, (unsigned long)longest);
    return fclose(out);
}
