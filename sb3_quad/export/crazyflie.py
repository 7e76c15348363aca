"""A policy as an app for the Crazyflie's firmware: an out-of-tree controller."""

import math

from sb3_quad.base.errors import ConfigError
from sb3_quad.base.types import StrDict
from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE, F
from sb3_quad.export.cost import cost_of
from sb3_quad.export.network import Network

FILES = ("Makefile", "Kbuild", "app-config", "README.md", "src/Kbuild", "src/sb3quad.c")
CALL = 0.001  # time between calls of the firmware, s
CYCLES = 168_000  # of its STM32F405 between two calls
# The policy's instructions may use a quarter of these cycles, or a half if it needs more: an
# instruction may take two cycles, and the firmware has other work to do.
SHARE = 0.25
MOST = 0.5
# THRUST_MIN and THRUST_MAX of the firmware's platforms, N: src/platform/interface in its repository
# of August 2026, with battery compensation.
PLATFORMS = (
    ("Crazyflie 2.x", 0.0128, 0.12),
    ("thrust upgrade kit", 0.0192, 0.18),
    ("Crazyflie 2.1 Brushless", 0.0214, 0.2),
)


def plan_app(network: Network) -> StrDict:
    """Return the variables of the file templates, except for names.

    :param network: its vehicle's rotors are M1 to M4 of the firmware.
    :raises ConfigError: thrusts that no platform provides; a policy that is too slow, or whose
        control step is not a multiple of the time between calls.
    """
    vehicle = network.trained.own
    high = vehicle.thrust_range[1]
    able = [platform for platform in PLATFORMS if high <= 1.0001 * platform[2]]
    if not able:
        raise ConfigError(
            f"vehicle {vehicle.name}: up to {high:.4g} N a rotor, more than any Crazyflie"
            " gives; say with --vehicle which one is to fly, such as crazyflie"
        )
    cost = cost_of(network)
    step = vehicle.control_step
    period = round(step / CALL)
    if not math.isclose(period * CALL, step):
        raise ConfigError(
            f"control_step {step:g} s: the Crazyflie's firmware calls every {CALL:g} s; "
            "train with a multiple of that"
        )
    # In units of the firmware's calls
    time = cost.instructions / CYCLES
    if time > MOST * period:
        raise ConfigError(
            f"the network takes {time:.1f} ms on the Crazyflie's chip, more than "
            f"half of the {1000 * step:g} ms between calls; train one with a smaller net_arch"
        )
    slices = min(math.ceil(time / SHARE), period)
    # The products of a row stay together, so that a slice may end up to a row early.
    longest_row = max(layer["inputs"] for layer in network.shapes)
    return {
        "network": network,
        "period": period,
        "slices": slices,
        "share": math.ceil(cost.multiplications / slices) + longest_row,
        "highest": high,
        "angle": network.trained.turn.angle,
        "features": OBSERVATION_SIZE,
        "F": F,
        "able": able,
    }
