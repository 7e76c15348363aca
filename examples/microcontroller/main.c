/* Observations of in.bin through policy.h to out.bin, float32, and instructions of a call on stdout: on this machine or in QEMU. */
#include <stdint.h>
#include <stdio.h>

#include "policy.h"

#define INPUTS (sizeof policy_policy_mean / sizeof(float))

#ifdef __arm__
/* QEMU's timer 2 counts nanoseconds, and with -icount shift=0 an instruction takes one. */
#define TIM2(offset) (*(volatile uint32_t *)(0x40000000 + (offset)))

static void begin(void)
{
    TIM2(0x00) = 1;
}

static uint32_t instructions(void)
{
    return TIM2(0x24);
}
#else
static void begin(void) {}
static uint32_t instructions(void) { return 0; }
#endif

int main(void)
{
    FILE *in = fopen("in.bin", "rb"), *out = fopen("out.bin", "wb");
    float observation[INPUTS], thrust[4];
    uint64_t sum = 0;
    uint32_t calls = 0, start, nothing;
#ifdef STATEFUL
    static policy_state state;

    policy_reset(&state);
#endif
    begin();
    start = instructions();
    nothing = instructions() - start;
    while (fread(observation, sizeof observation, 1, in) == 1) {
        start = instructions();
#ifdef STATEFUL
        policy_policy(&state, observation, thrust);
#else
        policy_policy(observation, thrust);
#endif
        sum += instructions() - start - nothing;
        ++calls;
        fwrite(thrust, sizeof thrust, 1, out);
    }
    printf("%lu %.1f\n", (unsigned long)calls, (double)sum / calls);
    return fclose(out);
}
