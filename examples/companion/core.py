"""The loop of a companion computer with any flight controller: look at the state, ask the policy
for collective thrust and body rates, and hand over as soon as something is wrong.

World axes: z up. Body axes: x forward, y left, z up. Units: m, m/s, rad/s, s. A link to a flight
controller turns its own frames and units to these.
"""

import itertools
import math
import re
import time
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

GRAVITY = 9.81
PATIENCE = 10.0  # s: how long it waits for the control


@dataclass
class State:
    """The state of the vehicle by an estimator.

    :ivar time: when it was measured, s, on the clock of the loop.
    :ivar position: world axes, m; ``velocity``: world axes, m/s.
    :ivar quaternion: (w, x, y, z), from body to world.
    :ivar body_rates: body axes, rad/s.
    """

    time: float
    position: np.ndarray
    quaternion: np.ndarray
    velocity: np.ndarray
    body_rates: np.ndarray

    @property
    def rotation(self) -> np.ndarray:
        """From body to world, (3, 3)."""
        w, x, y, z = self.quaternion / np.linalg.norm(self.quaternion)
        skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.eye(3) + 2.0 * (w * skew + skew @ skew)

    @property
    def tilt(self) -> float:
        """Angle between the body's z axis and the vertical, rad."""
        return math.acos(np.clip(self.rotation[2, 2], -1.0, 1.0))

    def observation(self, target: np.ndarray) -> np.ndarray:
        """Return the 18 numbers that an exported policy takes, for a target at rest, (3,)."""
        to_body = self.rotation.T
        parts = (self.position - target, to_body.ravel(), to_body @ self.velocity, self.body_rates)
        return np.concatenate(parts).astype(np.float32)


class Policy:
    """An exported ONNX file whose results are thrust and body rates. It is called once per
    ``period``, and its state holds last actions, earlier frames and the position integral.

    :raises ValueError: the file commands rotors, or has been written by another program.
    """

    def __init__(self, path: str) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(path, options, ["CPUExecutionProvider"])
        facts = self.session.get_modelmeta().custom_metadata_map
        if "collective thrust" not in facts.get("result", ""):
            raise ValueError(
                f"{path}: does not command thrust and body rates; export an agent that was trained"
                " with action: rates"
            )
        # One number for all rotors, or four of them
        (listed,) = re.findall(r"hover thrusts? (.*?) N,", facts["vehicle"])
        hover = listed.split(", ")
        self.weight = 4.0 * float(np.mean([float(number) for number in hover]))
        self.period = float(facts["period"].split()[0])
        #: Steps ahead of which it takes the acceleration of the reference
        ahead = re.findall(r"reference in (\d+) control steps", facts["observation"])
        self.preview = [int(steps) for steps in ahead]
        self.inputs = self.session.get_inputs()
        self.reset()

    def reset(self, flights: int = 1) -> None:
        """Begin flights, or continue after another controller has flown."""
        sizes = [entry.shape[1] for entry in self.inputs]
        # A preview of accelerations follows the 18 numbers; the target rests.
        self.values = [np.zeros((flights, size), np.float32) for size in sizes]

    def __call__(self, state: State, target: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the thrust divided by the weight, and body rates, rad/s."""
        thrusts, rates = self.command(state.observation(target)[None])
        return float(thrusts[0]), rates[0]

    def command(self, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the same for flights, (n,) and (n, 3), from their observations, (n, size) in units
        of :class:`State`. A size of 18 leaves out the preview.
        """
        self.values[0][:, : observations.shape[1]] = observations
        names = [entry.name for entry in self.inputs]
        given = dict(zip(names, self.values, strict=True))
        commands, *self.values[1:] = self.session.run(None, given)
        return commands[:, 0] / self.weight, commands[:, 1:].astype(float)


@dataclass
class HoverThrust:
    """How much throttle, in [0, 1], carries the weight. It is estimated in flight.

    :ivar throttle: the estimate; begin with what your controller shows in hover.
    :ivar power: thrust rises with the throttle to this power: 1 where the firmware linearizes the
        thrust, 2 where the throttle is the motors' speed.
    :ivar lag: from a throttle to its thrust, s; ``time_constant``: of the estimate, s.
    """

    throttle: float
    power: float = 1.0
    lag: float = 0.05
    time_constant: float = 2.0
    _last: State | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        self._expected = 1.0
        self.range = 0.5 * self.throttle, min(2.0 * self.throttle, 1.0)

    def command(self, thrust: float) -> float:
        """Return the throttle for a thrust divided by the weight."""
        return float(np.clip(self.throttle * max(thrust, 0.0) ** (1.0 / self.power), 0.0, 1.0))

    def update(self, state: State, throttle: float) -> None:
        """Learn from the velocity that a throttle has led to since the last state. Only flight that
        is close to hover teaches anything.
        """
        last, self._last = self._last, state
        if last is None:
            return
        dt = state.time - last.time
        if not 0.0 < dt < 0.1:
            return
        now = (throttle / self.throttle) ** self.power
        self._expected += (now - self._expected) * min(dt / self.lag, 1.0)
        felt = (state.velocity - last.velocity) / dt + [0.0, 0.0, GRAVITY]
        thrust = felt @ last.rotation[:, 2] / GRAVITY
        is_near = max(abs(thrust - 1.0), abs(self._expected - 1.0)) < 0.3
        if not is_near or state.tilt > math.radians(15.0):
            return
        change = (self._expected - thrust) * dt / (self.power * self.time_constant)
        self.throttle = float(np.clip(self.throttle * (1.0 + change), *self.range))


@dataclass
class Limits:
    """Where the policy may fly. Outside, the flight controller's own mode takes over."""

    oldest_state: float = 0.1  # s
    tilt: float = math.radians(60.0)
    tilted_for: float = 0.3  # s: how long it may be tilted by more
    height: tuple[float, float] = (0.3, 5.0)  # m
    distance: float = 5.0  # m, from the target
    body_rate: float = 25.0  # rad/s
    late: float = 0.05  # s: how late a step of the loop may be


class Watchdog:
    """Says what is wrong. It is asked once per step of the loop."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.upright: float | None = None
        self.last_check: float | None = None

    def fault(self, state: State | None, target: np.ndarray, now: float) -> str:
        """Return why the policy must not fly on, or an empty string."""
        limits = self.limits
        waited = 0.0 if self.last_check is None else now - self.last_check
        self.last_check = now
        if state is None or now - state.time > limits.oldest_state:
            return f"no state for {limits.oldest_state} s"
        parts = (state.position, state.quaternion, state.velocity, state.body_rates)
        if not np.isfinite(np.concatenate(parts)).all() or not state.quaternion.any():
            return "the state is not finite"
        if self.upright is None or state.tilt <= limits.tilt:
            self.upright = now
        least, most = limits.height
        faults = {
            "the loop is late": waited > limits.late,
            "tilted for too long": now - self.upright > limits.tilted_for,
            f"height {state.position[2]:.2f} m": not least <= state.position[2] <= most,
            "too far from the target": np.linalg.norm(state.position - target) > limits.distance,
            "spins too fast": np.abs(state.body_rates).max() > limits.body_rate,
        }
        return next((name for name, is_true in faults.items() if is_true), "")


class Link(Protocol):
    """A flight controller."""

    def state(self) -> State | None:
        """The latest state; None before the first."""

    def refusal(self) -> str:
        """Why the policy must not take over, or an empty string. Sends nothing."""

    def take_over(self) -> None:
        """Ask the flight controller to follow commands, which have been coming for a while."""

    def is_ours(self) -> bool:
        """Whether the flight controller follows commands. A pilot may take over at any time."""

    def send(self, throttle: float, body_rates: np.ndarray) -> None:
        """Command a throttle in [0, 1] and body rates, rad/s."""

    def hand_over(self, fault: str) -> None:
        """Let the flight controller fly on by itself."""


def fly(link, policy, hover, target, limits, seconds, clock=time.monotonic, sleep=time.sleep):
    """Fly to a target for some seconds, and hand over. Return why it ended; empty: time is over.

    The vehicle is in the air, and another mode of its controller flies it. First, commands to hover
    are streamed, since some flight controllers follow none otherwise. After half a second it asks
    for the control, and when it has it, the policy begins.

    :raises RuntimeError: the flight controller is not ready; nothing was sent.
    """
    watchdog = Watchdog(limits)
    refusal = link.refusal() or watchdog.fault(link.state(), target, clock())
    if refusal:
        raise RuntimeError(f"not taking over: {refusal}")
    watchdog.last_check = None
    policy.reset()
    n_first = round(0.5 / policy.period)
    n_patience = n_first + round(PATIENCE / policy.period)
    n_steps = round(seconds / policy.period)
    flown = -1  # steps of the policy; -1: it does not fly yet
    fault = "the companion loop failed"
    begin = clock()
    try:
        for step in itertools.count():
            state = link.state()
            fault = watchdog.fault(state, target, clock())
            is_ours = step > n_first and link.is_ours()
            if not fault and flown >= 0 and not is_ours:
                fault = "another mode flies"
            if not fault and flown < 0 and step > n_patience:
                fault = f"no control after {PATIENCE:g} s"
            if fault or flown >= n_steps:
                break
            thrust, body_rates = 1.0, np.zeros(3)
            if is_ours:
                thrust, body_rates = policy(state, target)
                flown += 1
            throttle = hover.command(thrust)
            link.send(throttle, body_rates)
            if step == n_first:
                link.take_over()
            if flown > 0:
                hover.update(state, throttle)
            sleep(max(0.0, begin + (step + 1) * policy.period - clock()))
    except BaseException:
        fault = "the companion loop failed"
        raise
    finally:
        link.hand_over(fault)
    return fault
