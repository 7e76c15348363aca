#pragma once
#include <stdbool.h>
#include <stdint.h>

#define RATE_MAIN_LOOP 1000
#define STABILIZER_NR_OF_MOTORS 4
#define VECTOR(NAME) typedef struct { uint32_t timestamp; float x, y, z; } NAME

typedef uint32_t stabilizerStep_t;
typedef struct { uint32_t timestamp; float roll, pitch, yaw; } attitude_t; /* degrees */
typedef struct { float x, y, z, w; } quaternion_t;
typedef struct { float x, y, z; } Axis3f;
VECTOR(point_t);
VECTOR(velocity_t);
VECTOR(acc_t);
VECTOR(jerk_t);

typedef struct { Axis3f acc; /* g */ Axis3f gyro; /* degrees/s */ Axis3f mag; } sensorData_t;
typedef struct {
    attitude_t attitude;
    quaternion_t attitudeQuaternion; /* body to world */
    point_t position;
    velocity_t velocity; /* world */
    acc_t acc;
} state_t;

typedef enum { modeDisable, modeAbs, modeVelocity } stab_mode_t;
typedef struct { stab_mode_t x, y, z, roll, pitch, yaw, quat; } setpoint_mode_t;
typedef struct {
    uint32_t timestamp;
    attitude_t attitude, attitudeRate;
    quaternion_t attitudeQuaternion;
    float thrust;
    point_t position;
    velocity_t velocity;
    acc_t acceleration; /* m/s^2 */
    jerk_t jerk;
    bool velocity_body;
    setpoint_mode_t mode;
} setpoint_t;

typedef enum { controlModeLegacy, controlModeForceTorque, controlModeForce } control_mode_t;
typedef struct {
    union {
        struct { int16_t roll, pitch, yaw; float thrust; };
        float normalizedForces[STABILIZER_NR_OF_MOTORS]; /* M1 to M4, of THRUST_MAX */
    };
    control_mode_t controlMode;
} control_t;

typedef struct { int32_t list[STABILIZER_NR_OF_MOTORS]; } motors_thrust_uncapped_t;
typedef struct { uint16_t list[STABILIZER_NR_OF_MOTORS]; } motors_thrust_pwm_t;
