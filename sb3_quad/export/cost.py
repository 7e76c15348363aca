"""What a policy's C header costs on a microcontroller: memory, instructions, time."""

from typing import NamedTuple

from sb3_quad.export.network import Network

# Instructions of a call, compiled for a Cortex-M4F by arm-none-eabi-gcc 12.2 -Os: least squares of
# what examples/microcontroller/measure.py counts in QEMU.
PER_MULTIPLICATION = 4.36
PER_UNIT = {"tanh": 104.0, "relu": 12.0, "none": 0.0}
PER_CALL = 2365.0
KB = 1024


# Microcontrollers of flight controllers: flash, kB, and clock, MHz.
CHIPS = {
    "STM32F405 (Cortex-M4)": (1024, 168),
    "STM32F722 (Cortex-M7)": (512, 216),
    "STM32H743 (Cortex-M7)": (2048, 480),
}


class Cost(NamedTuple):
    """Of one call, but for the memory."""

    flash: int  # bytes, of the weights and the scaling
    ram: int  # bytes between calls
    stack: int  # bytes
    multiplications: int
    instructions: float

    def describe(self, period: float) -> str:
        """Return a line for the users of a header that is called every ``period`` seconds."""
        chips = []
        for chip, (kilobytes, clock) in CHIPS.items():
            milliseconds = self.instructions / (1000 * clock)
            flash = self.flash / (KB * kilobytes)
            # The other programs of a flight controller need the rest.
            fits = "fits" if max(flash, milliseconds / 1000 / period) < 1.0 else "does not fit"
            chips.append(
                f"{fits} {chip}: {milliseconds:.2f} ms at {clock} MHz, "
                f"{100 * flash:.0f} % of {kilobytes:,} kB"
            )
        return (
            f"{self.flash:,} bytes of flash, {self.ram:,} of RAM, {self.stack:,} of stack; "
            f"{self.multiplications:,} multiplications and about "
            f"{self.instructions / 1000:,.0f} thousand instructions a call, "
            f"by one instruction a cycle: {'; '.join(chips)}"
        )


def cost_of(network: Network) -> Cost:
    """Return what a policy's header costs."""
    flash = 4 * sum(values.numel() for values in network.parameters())
    flash += 8 * network.mean.numel()
    stack = 4 * network.shapes[0]["inputs"]
    multiplications = 0
    instructions = PER_CALL
    for layer in network.shapes:
        stack += 4 * layer["outputs"]
        multiplications += layer["inputs"] * layer["outputs"]
        instructions += PER_UNIT[layer["activation"]] * layer["outputs"]
    instructions += PER_MULTIPLICATION * multiplications
    # The struct of the template: a ring of frames with its place, the integral.
    ram = 0
    observation = network.observation
    if observation.is_extended:
        ram = 4 + 4 * (observation.ages[-1] + 1) * observation.frame_size
        ram += 16 * bool(network.integral)
    return Cost(flash, ram, stack, multiplications, instructions)
