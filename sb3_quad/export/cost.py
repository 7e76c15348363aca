"""The cost of a policy's C header on a microcontroller: memory, instructions, time."""

from typing import NamedTuple

from sb3_quad.export.network import Network

# Instructions of a call, compiled for a Cortex-M4F by arm-none-eabi-gcc 12.2 -Os: a least-squares
# fit to the counts of examples/microcontroller/measure.py in QEMU
PER_MULTIPLICATION = 4.36
PER_UNIT = {"tanh": 104.0, "relu": 12.0, "none": 0.0}
PER_CALL = 2365.0


class Cost(NamedTuple):
    """The cost of one call, and the memory."""

    flash: int  # bytes, of the weights and the scaling
    ram: int  # bytes between calls
    stack: int  # bytes
    multiplications: int
    instructions: float


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
    # The struct of the template: a ring of frames with its position, and the integral
    ram = 0
    observation = network.observation
    if observation.is_extended:
        ram = 4 + 4 * (observation.ages[-1] + 1) * observation.frame_size
        ram += 16 * bool(network.integral)
    return Cost(flash, ram, stack, multiplications, instructions)
