"""Fly an agent by hand in PyBullet's window: you steer, it flies.

    python examples/joystick.py
    python examples/joystick.py any-quadcopter --speed 4
    pip install pygame  # for a gamepad

Keys, with the window in front: arrows move forward, back, left and right, w and s up and down, a
and d turn, q quits. A gamepad is used instead if pygame is installed and one is plugged in: its
right stick moves, its left one climbs and turns; give `--axes` if yours numbers them differently.

A stick commands a velocity and a yaw rate, in the frame of the heading. A filter smooths them, so
that the acceleration of the reference is finite, too; its position is the integral of the velocity.
"""

import argparse
import sys
from typing import Any

import gymnasium
import numpy as np
import pybullet

import sb3_quad  # noqa: F401  (registers the environments)
from sb3_quad.agents.agent_settings import env_kwargs
from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.agents.zips import load_model
from sb3_quad.envs.rendering.window import has_display

FLOOR = 2.0  # m, the lowest height of the reference
LEASH = 3.0  # m: the reference waits for a vehicle that is farther away
FREQUENCY = 4.0  # rad/s, of the filter of velocities
TURN_LAG = 0.2  # s, of the filter of the yaw rate


class Keyboard:
    """The keys that are down in PyBullet's window, as sticks."""

    def __call__(self):
        """Return forward, left, up and turn (to the left), each in [-1, 1]; None: the end."""
        events = pybullet.getKeyboardEvents()
        down = {key for key, state in events.items() if state & pybullet.KEY_IS_DOWN}
        if ord("q") in down:
            return None
        pairs = [
            (pybullet.B3G_UP_ARROW, pybullet.B3G_DOWN_ARROW),
            (pybullet.B3G_LEFT_ARROW, pybullet.B3G_RIGHT_ARROW),
            (ord("w"), ord("s")),
            (ord("a"), ord("d")),
        ]
        return [float((more in down) - (less in down)) for more, less in pairs]


class Gamepad:
    """The first gamepad that pygame finds.

    :param axes: the numbers of its axes for forward, left, up and turn, which all count backwards.
    """

    def __init__(self, pygame, axes):
        self.pygame = pygame
        self.axes = axes
        self.device = pygame.joystick.Joystick(0)
        largest = max(axes)
        if largest >= self.device.get_numaxes():
            sys.exit(f"--axes {largest}: {self.device.get_name()} has {self.device.get_numaxes()}")

    def __call__(self):
        """Return what :class:`Keyboard` does."""
        self.pygame.event.pump()
        values = np.array([-self.device.get_axis(axis) for axis in self.axes])
        # Released sticks do not come to rest exactly in the middle.
        return np.sign(values) * np.clip(np.abs(values) - 0.1, 0.0, None) / 0.9


class Guide:
    """The reference that a stick moves.

    :param speed: the velocity that a full stick commands, m/s; ``turn`` likewise, rad/s.
    :param dt: control step, s.
    """

    def __init__(self, position, speed, turn, dt):
        self.position = np.array(position, dtype=float)
        self.velocity = np.zeros(3)
        self.acceleration = np.zeros(3)
        self.heading = 0.0
        self.heading_rate = 0.0
        self.speed = speed
        self.turn = turn
        self.dt = dt

    def advance(self, stick, vehicle):
        """Move by a control step. ``vehicle``: where the vehicle is, (3,), m."""
        forward, left, up, turn = stick
        c, s = np.cos(self.heading), np.sin(self.heading)
        wanted = self.speed * np.array([c * forward - s * left, s * forward + c * left, up])
        # Slow down in time for the floor, and wait for the vehicle.
        wanted[2] = max(wanted[2], (FLOOR - self.position[2]) * FREQUENCY / 4)
        wanted *= np.linalg.norm(self.position - vehicle) < LEASH
        # A critically damped filter of second order: the velocity follows without overshoot.
        jerk = FREQUENCY**2 * (wanted - self.velocity) - 2.0 * FREQUENCY * self.acceleration
        self.acceleration += self.dt * jerk
        self.velocity += self.dt * self.acceleration
        self.position += self.dt * self.velocity
        self.heading_rate += self.dt / TURN_LAG * (self.turn * turn - self.heading_rate)
        self.heading += self.dt * self.heading_rate

    @property
    def reference(self):
        """The arguments of ``env.set_reference``."""
        return self.position, self.velocity, self.acceleration, self.heading, self.heading_rate


def fly(agent, stick, speed=3.0, turn=1.5, render_mode="human"):
    """Fly until the stick returns None or the window is shut.

    Yield the environment and the reference after each control step.

    :param agent: name of an agent of the package, or path of a zip.
    :param stick: a function that returns forward, left, up and turn, each in [-1, 1], or None.
    """
    # A name of the package stands for a zip here; an agent brings its vehicle and observation.
    path = pretrained_path(agent) or agent
    model = load_model(path)
    settings = {**env_kwargs(path), "task": "target_tracking", "reference": None}
    # The vehicle, where an agent flies any
    settings = {**settings, "vehicles": None, "randomize": None}
    settings["task_kwargs"] = {"target_distance": 0.0, "nearest_target": 0.0}
    settings.pop("max_episode_steps", None)
    made = gymnasium.make("QuadTargetTracking-v0", -1, render_mode=render_mode, **settings)
    env: Any = made.unwrapped
    dt = env.vehicle.control_step
    env.reset(seed=0)
    guide = Guide(env.target, speed, turn, dt)
    try:
        while (asked := stick()) is not None:
            env.set_reference(*guide.reference)
            action, _ = model.predict(env.observe(), deterministic=True)
            lost = env.step(action)[2]
            guide.advance(np.clip(asked, -1.0, 1.0), env.true_state().position[0])
            yield env, guide
            if lost:
                print("lost; it begins again")
                env.reset()
                guide = Guide(env.target, speed, turn, dt)
    except pybullet.error:
        # The window was shut.
        pass
    finally:
        env.close()


def plugged_in():
    """Return pygame if it is installed and finds a gamepad, otherwise None."""
    try:
        import pygame
    except ImportError:
        return None
    pygame.display.init()
    pygame.joystick.init()
    return pygame if pygame.joystick.get_count() else None


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("agent", nargs="?", default="itm-robust", help="name or zip (itm-robust)")
    parser.add_argument("--speed", type=float, default=3.0, help="of a full stick, m/s (3)")
    parser.add_argument("--turn", type=float, default=1.5, help="of a full stick, rad/s (1.5)")
    parser.add_argument(
        "--axes",
        type=int,
        nargs=4,
        default=[4, 3, 1, 0],
        help="of a gamepad: forward, left, up, turn (4 3 1 0)",
    )
    arguments = parser.parse_args()
    if not has_display():
        sys.exit("no display to open a window on: DISPLAY is not set")
    found = plugged_in()
    sticks = Gamepad(found, arguments.axes) if found else Keyboard()
    print("gamepad" if found else "keyboard: arrows, w, s, a, d; q ends")
    worst = 0.0
    for flown, wanted in fly(arguments.agent, sticks, arguments.speed, arguments.turn):
        off = np.linalg.norm(flown.true_state().position[0] - wanted.position)
        worst = max(worst, float(off))
    print(f"farthest from its reference: {worst:.2f} m")
