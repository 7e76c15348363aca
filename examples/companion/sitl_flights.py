"""Flights behind an autopilot's SITL, and the same with ``action="rates"`` next to them."""

import argparse
import math
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from core import HoverThrust, Policy, State

from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.observation import OBSERVATION_SIZE
from sb3_quad.envs.simulation.settings import ENDLESS, FlightSettings
from sb3_quad.envs.simulation.tracks import ACCELERATION_STD
from sb3_quad.experts.geometric import GeometricExpert

EXAMPLES = Path(__file__).resolve().parent.parent
STEP = 0.001  # s: of the physics, and between packets
PERIOD = 0.01  # s, between two commands; a command answers the state one period before
HEIGHT = 20.0  # m, of the target
HEADER = """\
| flight | loop | ends within 0.1 m | rms at the end, m | at most | there after, s | sinks, m |
|---|---|---|---|---|---|---|"""


@dataclass
class Flight:
    """What is flown."""

    seconds: float
    counted: float = 1.0  # s at its end, of which the root mean square is
    step: float = 0.0  # m, of the target
    roll: float = 0.0  # degrees, at the start
    reference: str | None = None


FLIGHTS = {
    "hover": Flight(2.0),
    "5 m step": Flight(3.0, step=5.0),
    "10 m step": Flight(4.0, step=10.0),
    "120° of roll": Flight(3.0, roll=120.0),
    # Half a lap counts: 4.44 s.
    "figure eight": Flight(6.5, counted=4.5, reference="figure_eight"),
}


def command(pilot, batch):
    """Return thrusts divided by the weight, (n,), and body rates, (n, 3), for a batch of n."""
    if isinstance(pilot, Policy):
        observations = batch.observe()
        observations[:, OBSERVATION_SIZE:] *= ACCELERATION_STD
        return pilot.command(observations)
    actions = pilot.actions(batch.true_state())
    vehicle = pilot.vehicle
    limits, _ = vehicle.rate_limits_and_gains
    return vehicle.action_to_thrust(actions[:, 0]) / vehicle.hover_thrust, actions[:, 1:] * limits


def starts(flight, n, seed):
    """Return what n flights, which start at rest but for their body rates, start with, (size, n)
    each, by name.
    """
    rng = np.random.default_rng(seed)
    heading, direction = rng.uniform(-math.pi, math.pi, (2, n))
    roll = math.radians(flight.roll) * rng.choice([-1.0, 1.0], n)
    target = np.tile([[0.0], [0.0], [HEIGHT]], n)
    way = np.stack([np.cos(direction), np.sin(direction), 0.0 * direction])
    c, s = np.cos(roll / 2.0), np.sin(roll / 2.0)
    cosine, sine = np.cos(heading / 2.0), np.sin(heading / 2.0)
    return {
        "target": target,
        "position": target + flight.step * way,
        "quaternion": np.stack([cosine * c, cosine * s, sine * s, sine * c]),
        "body_rates": rng.standard_normal((n, 3)).T * (roll != 0.0),
    }


def new_batch(flight, start, pilot, vehicle, action):
    """Return vehicles at the start of their flights, and let the pilot begin, too."""
    n = start["target"].shape[1]
    preview = None
    if isinstance(pilot, Policy):
        pilot.reset(n)
        ratio = PERIOD / vehicle.control_step
        preview = tuple(round(ahead * ratio) for ahead in pilot.preview)
    settings = FlightSettings(
        vehicle=vehicle,
        action=action,
        noise=0.0,
        max_episode_steps=ENDLESS,
        observation_std=[1.0] * OBSERVATION_SIZE,
        preview=preview,
        reference=flight.reference,
    )
    batch = QuadcopterBatch(n, settings, 0, 1, autoreset=False)
    batch.reset()
    for name, values in start.items():
        batch.fix(name, values)
    return batch


def fly(flight, pilot, batch, advance):
    """Return positions from the target, (steps, n, 3), every ``PERIOD``.

    :param advance: flies a period with the commands of the pilot.
    """
    path = []
    for _ in range(round(flight.seconds / PERIOD)):
        state = batch.true_state()
        path.append(state.position - state.target)
        advance(*command(pilot, batch))
    return np.array(path)


def fly_in_model(flight, pilot, vehicle, n, seed):
    """Fly with ``action="rates"``; see ``fly``."""
    batch = new_batch(flight, starts(flight, n, seed), pilot, vehicle, "rates")
    limits, _ = vehicle.rate_limits_and_gains

    def advance(thrusts, rates):
        actions = vehicle.thrust_to_action(thrusts * vehicle.hover_thrust), rates / limits
        batch.step(np.column_stack(actions))

    return fly(flight, pilot, batch, advance)


class Behind:
    """A batch of one vehicle behind a SITL, as ``fly`` advances it."""

    def __init__(self, batch, sitl, vehicle) -> None:
        self.batch = batch
        self.sitl = sitl
        self.vehicle = vehicle
        # Full throttle gives the greatest thrust.
        power = math.log(1.0 / vehicle.thrust_limits[1], sitl.hover)
        self.hover = HoverThrust(sitl.hover, power)
        self.pending = sitl.hover, np.zeros(3)

    def state(self) -> State:
        # A copy, since HoverThrust compares it with the next one.
        state = self.batch.true_state().copy()
        parts = state.position, state.quaternion, state.velocity, state.body_rates
        return State(self.sitl.time, *(part[0] for part in parts))

    def __call__(self, thrusts, rates):
        """Send the commands of one period before, and fly on."""
        sent = self.pending
        self.pending = self.hover.command(thrusts[0]), rates[0]
        self.sitl.send(*sent)
        _, most = self.vehicle.thrust_range
        for _ in range(self.vehicle.substeps):
            thrust = most * self.sitl.step(self.state()) ** 2
            self.batch.step(self.vehicle.thrust_to_action(thrust)[None])
        self.hover.update(self.state(), sent[0])


def fly_in_sitl(flight, pilot, vehicle, n, seed, sitl):
    """Fly behind a SITL, one flight after another; see ``fly``."""
    fast = vehicle.model_copy(update={"control_step": STEP, "delay": 0})
    whole = starts(flight, n, seed)
    paths = []
    for run in range(n):
        start = {name: values[:, run : run + 1] for name, values in whole.items()}
        batch = new_batch(flight, start, pilot, fast, "thrusts")
        behind = Behind(batch, sitl, vehicle)
        sitl.begin(behind.state())
        paths.append(fly(flight, pilot, batch, behind))
    return np.hstack(paths)


def figures(flight, path):
    """Return the figures of a row of the table."""
    distance = np.linalg.norm(path, axis=2)
    counted = distance[-round(flight.counted / PERIOD) :]
    rms = np.sqrt((counted**2).mean(axis=0))
    outside = distance >= 0.1
    arrival = PERIOD * (len(distance) - outside[::-1].argmax(axis=0)) * outside.any(axis=0)
    lost_height = -path[:, :, 2].min(axis=0)
    good = ~outside[-1] & (lost_height < HEIGHT)
    numbers = (np.median(rms), rms.max(), np.median(arrival), np.median(lost_height))
    return f"{good.sum()} of {len(good)}", *(f"{number:.3f}" for number in numbers)


def parser_of(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options of all SITLs."""
    parser = argparse.ArgumentParser(description=description.split("\n\n")[0])
    parser.add_argument("--policy", default="geometric", help="geometric, or an exported ONNX file")
    parser.add_argument("--vehicle", default=str(EXAMPLES / "five_inch.yaml"))
    parser.add_argument("--runs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--flights", nargs="+", choices=FLIGHTS, default=list(FLIGHTS))
    return parser


def compare(options, vehicle, name, start):
    """Fly in our loop and behind a SITL, and print the table.

    :param start: returns the SITL.
    """
    is_expert = options.policy == "geometric"
    pilot = GeometricExpert(vehicle, action="rates") if is_expert else Policy(options.policy)
    print(HEADER)
    with closing(start()) as sitl:
        for flown in options.flights:
            flight = FLIGHTS[flown]
            arguments = flight, pilot, vehicle, options.runs, options.seed
            paths = {"rates": fly_in_model(*arguments), name: fly_in_sitl(*arguments, sitl)}
            for loop, path in paths.items():
                print("|", " | ".join([flown, loop, *figures(flight, path)]), "|", flush=True)
