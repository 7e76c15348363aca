"""What a Crazyflie's firmware does in flight: which flights it cuts, and what a low battery costs.

    python examples/firmware.py volts
    python examples/firmware.py supervisor crazyflie-robust my.zip -n 3840
    python examples/firmware.py battery crazyflie-robust --lowest 0.89 -n 960

Agents are names, zips or run folders, and fly ``--vehicle`` with the noise that they were trained
with. All constants are those of bitcraze/crazyflie-firmware, commit 2a18fc2 (2026).
"""

import argparse
import math
from typing import Any

import numpy as np
from stable_baselines3 import PPO

from sb3_quad import env_kwargs, fly
from sb3_quad.agents.pretrained import agent_path
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.flights import Flights
from sb3_quad.evaluation.hooks import Hook
from sb3_quad.evaluation.supervisor import (
    FREE_FALL,
    LOW,
    LOW_TIME,
    UPSIDE_DOWN,
    UPSIDE_DOWN_TIME,
    Supervisor,
)

TASKS = ("state_recovery", "target_tracking")
# src/platform/interface/platform_defaults_cf2.h and _cf21bl.h: the thrust of a rotor, N, is a
# polynomial in its motor's voltage, the constant first; then the largest thrust that is commanded.
MOTORS = {
    "legacy propellers": (
        [-0.014830744918356092, 0.04724465241828281, -0.01847364358025878, 0.005960923942142],
        0.12,
    ),
    "2.1+ propellers": (
        [-0.02476537915958403, 0.06523793527519485, -0.026792504967750107, 0.006776789303971145],
        0.12,
    ),
    "thrust upgrade kit": (
        [0.006728127583707208, 0.01011557616217668, 0.010263198062061085, 0.0028358638322392503],
        0.18,
    ),
    "brushless": (
        [-0.014058926705279723, 0.04265273261724981, 0.0018327760144017432, 0.0020576974784587178],
        0.2,
    ),
}
VOLTAGES = (4.2, 3.7, 3.2, 3.0, 2.85)
PERIOD = 4  # control steps of 10 ms between two checks of the firmware (RATE_25_HZ)
CUTOFF = 30.0  # Hz, ACCEL_LPF_CUTOFF_FREQ of src/hal/src/sensors_bmi088_bmp3xx.c


def print_volts() -> None:
    """Print how much a supply voltage leaves of the largest thrust, and of a thrust without
    compensation.
    """
    for name, (polynomial, largest) in MOTORS.items():
        thrust = np.polynomial.Polynomial(polynomial)
        roots = np.asarray((thrust - largest).roots())
        least = float(roots.real[np.abs(roots.imag) < 1e-9].min())
        slower = math.sqrt(thrust(0.9 * least) / largest)
        print(
            f"{name}, at most {largest} N a rotor, at {least:.2f} V; with 90 % of that voltage"
            f" it turns at {100 * slower:.0f} % of the speed:"
        )
        for voltage in VOLTAGES:
            # With compensation, a command gets its thrust as long as the voltage suffices.
            most = min(thrust(voltage) / largest, 1.0)
            print(f"  {voltage:.2f} V: largest {thrust(voltage):.4f} N, {100 * most:.0f} %", end="")
            # Without compensation, the duty cycle is the force divided by the largest one.
            plain = 2.0 * thrust(voltage / 2.0) / largest
            print(f"; without compensation a command of half the most gives {100 * plain:.0f} %")


class Firmware(Hook):
    """The supervisor as the firmware runs it, at every phase of its 25 Hz: ``cut`` (phases, n).

    The accelerometer's samples, at 1,000 Hz and linear between two control steps, go through the
    firmware's second-order low-pass (src/utils/src/filter.c).
    """

    def on_start(self, state, vehicle):
        self.gravity = vehicle.gravity
        self.last = state.specific_force / vehicle.gravity
        self.delays = np.zeros((2, *self.last.shape))
        self.since = np.full((PERIOD, state.n), np.nan)
        self.cut = np.zeros((PERIOD, state.n), bool)
        warp = math.tan(math.pi * CUTOFF / 1000.0)
        scale = 1.0 + 2.0 * math.cos(math.pi / 4.0) * warp + warp**2
        self.gain = warp**2 / scale
        self.feedback = (
            2.0 * (warp**2 - 1.0) / scale,
            (1.0 - 2.0 * math.cos(math.pi / 4.0) * warp + warp**2) / scale,
        )
        # The filter is at rest at the first force.
        self.delays[:] = self.last / (1.0 + sum(self.feedback))

    def filtered(self, force):
        """Return the output of the filter after one more sample, (n, 3)."""
        first, second = self.delays
        newest = force - self.feedback[0] * first - self.feedback[1] * second
        self.delays = np.stack([newest, first])
        return self.gain * (newest + 2.0 * first + second)

    def after_step(self, step, state, actions, flying):
        force = state.specific_force / self.gravity
        for part in np.linspace(0.1, 1.0, 10):
            shown = self.filtered(self.last + part * (force - self.last))
        self.last = force
        since = self.since[step % PERIOD]
        time = 0.01 * step
        along_z = shown[:, 2]
        since[(np.abs(shown) < FREE_FALL).all(axis=1)] = np.nan
        since[(along_z >= LOW) | ~flying] = np.nan
        starts = np.isnan(since) & (along_z < LOW) & flying
        since[starts] = time
        allowed = np.where(along_z < UPSIDE_DOWN, UPSIDE_DOWN_TIME, LOW_TIME)
        self.cut[step % PERIOD] |= time - since > allowed + 1e-9


def flown(arguments, agent, task, hooks=(), **changes) -> Flights:
    """Fly an agent with some settings changed."""
    settings = env_kwargs(agent) | {"vehicle": arguments.vehicle, "vehicles": None} | changes
    model = PPO.load(agent_path(agent), device="cpu")
    return fly(model, task, arguments.n, arguments.seed, hooks=hooks, **settings)


def print_supervisor(arguments) -> None:
    """Print how many flights would be cut, by this package's rule and by the firmware's own."""
    for agent in arguments.agents:
        for task in TASKS:
            firmware = Firmware()
            supervisor = Supervisor()
            flights = flown(arguments, agent, task, [firmware, supervisor])
            watched = supervisor.results()
            print(
                f"{agent}, {task}: {flights.success.sum()} succeed, settling time"
                f" {np.nanmean(flights.settling_time[0.1]):.2f} s,"
                f" {watched['cut_by_supervisor'].sum()} of {flights.n} cut, longest"
                f" {1000 * watched['low_force_time'].max():.0f} ms below 0.5 g; filtered and at"
                f" 25 Hz, by phase: {firmware.cut.sum(axis=1).tolist()}",
                flush=True,
            )


def print_battery(arguments) -> None:
    """Print how flights go with a full and a low battery, by either saturation."""
    vehicle = load_vehicle(arguments.vehicle)
    shared = vehicle.model_copy(update={"saturation": "shared"})
    low = {"randomize": {"battery": arguments.lowest}}
    conditions: dict[str, dict[str, Any]] = {
        "full battery": {},
        "full battery, shared saturation": {"vehicle": shared},
        "low battery": low,
        "low battery, shared saturation": {"vehicle": shared, **low},
    }
    for agent in arguments.agents:
        for task in TASKS:
            for name, changes in conditions.items():
                supervisor = Supervisor()
                flights = flown(arguments, agent, task, [supervisor], **changes)
                cut = supervisor.results()["cut_by_supervisor"].sum()
                settling = flights.settling_time[0.1]
                print(
                    f"{agent}, {task}, {name}: {100 * flights.success.mean():.2f} % succeed,"
                    f" {np.isfinite(settling).mean() * 100:.2f} % settle, after"
                    f" {np.nanmean(settling):.2f} s, {cut} cut",
                    flush=True,
                )


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=["volts", "supervisor", "battery"])
    parser.add_argument("agents", nargs="*")
    parser.add_argument("--vehicle", default="crazyflie")
    parser.add_argument("--lowest", type=float, default=0.89, help="share of the largest thrust")
    parser.add_argument("-n", type=int, default=960, help="flights of each")
    parser.add_argument("--seed", type=int, default=61)
    arguments = parser.parse_args()
    if arguments.what == "volts":
        print_volts()
    elif arguments.what == "supervisor":
        print_supervisor(arguments)
    else:
        print_battery(arguments)


if __name__ == "__main__":
    main()
