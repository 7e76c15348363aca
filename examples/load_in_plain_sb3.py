"""Fly a trained agent where only Stable-Baselines3 is installed.

    python examples/load_in_plain_sb3.py sb3_quad/agents/pretrained/itm-robust.zip

Nothing here imports sb3_quad: the zip says what its agent observes. Copy `Observation` to your own
simulator or vehicle, which `Quadcopter` represents here.
"""

import argparse
import sys

import numpy as np
from stable_baselines3 import PPO

# Scale of the features if the zip contains none
STD = np.repeat([10 / np.sqrt(3), np.sqrt(3), 5.0, 5.0], [3, 9, 3, 3])


class Observation:
    """Makes the agent's observations in an episode from the state in SI units, for a target that
    rests. Call it once in every control step.
    """

    def __init__(self, settings):
        mean = settings.get("observation_mean")
        std = settings.get("observation_std")
        self.mean = np.array(0.0 if mean is None else mean)
        self.std = np.array(STD if std is None else std)
        # Ages of the observed frames, control steps, and whether a frame ends with the last action.
        self.ages = settings.get("history") or [0]
        self.last_action = settings.get("last_action", False)
        self.rule = settings.get("position_integral")
        # The acceleration of a moving target, in each previewed control step; this one rests.
        self.ahead = np.zeros(3 * len(settings.get("preview") or []))
        self.control_step = settings["vehicle"]["control_step"]
        self.frames = []  # the latest frame first
        self.integral = np.zeros(3)

    def __call__(self, position, rotation, velocity, body_rates, action):
        """Return the observation, float32 of shape (18,) or longer.

        It holds the scaled features of the current and of earlier control steps, each with the
        action before it.

        :param position: relative to the target, world frame, z up, m.
        :param rotation: matrix (3, 3), body to world.
        :param velocity: world frame, m/s.
        :param body_rates: body frame, rad/s.
        :param action: the agent's last action, (4,); zeros at the start.
        """
        # The integral grows only near the target, where it removes a constant offset.
        rule = self.rule
        if rule and self.frames:
            near = np.linalg.norm(position) < rule["distance"]
            if near and np.linalg.norm(velocity) < rule["speed"]:
                self.integral += rule["gain"] * self.control_step * position
                self.integral = self.integral.clip(-rule["limit"], rule["limit"])

        features = np.concatenate(
            [position + self.integral, rotation.T.ravel(), rotation.T @ velocity, body_rates]
        )
        frame = (features - self.mean) / self.std
        if self.last_action:
            frame = np.concatenate([frame, np.clip(action, -1, 1)])
        self.frames = [frame, *self.frames[: self.ages[-1]]]
        # Frames from before the episode are zeros.
        observed = []
        for age in self.ages:
            observed.append(self.frames[age] if age < len(self.frames) else np.zeros_like(frame))
        return np.concatenate([*observed, self.ahead]).astype(np.float32)


class Quadcopter:
    """The vehicle of the zip, without wind, initially level and at rest."""

    def __init__(self, vehicle, position):
        self.vehicle = vehicle
        self.position = position
        self.rotation = np.eye(3)
        self.velocity = np.zeros(3)
        self.body_rates = np.zeros(3)
        # Older zips have one motor gain for both directions.
        same = vehicle.get("motor_gain")
        self.motor_gains = [vehicle.get(f"motor_gain_{which}", same) for which in ("up", "down")]
        x, y = np.transpose(vehicle["rotor_positions"])
        yaw_arms = vehicle["moment_thrust_ratio"] * np.array(vehicle["rotor_directions"])
        self.arms = np.stack([y, -x, yaw_arms])
        # Thrust of a rotor in hover, and at the actions -1 and 1, N.
        hover = vehicle["mass"] * vehicle["gravity"] / 4
        self.low, self.high = hover * np.array(vehicle["thrust_limits"])
        self.commands = vehicle["delay"] * [np.full(4, hover)]
        self.roots = np.full(4, np.sqrt(hover))

    def step(self, action):
        """Fly one control step.

        The square roots of the thrusts follow the commands with a lag, as the rotors' speeds do.
        """
        half_range = (self.high - self.low) / 2
        thrusts = (self.low + self.high) / 2 + half_range * np.clip(action, -1, 1)
        self.commands.append(thrusts)
        command = self.commands.pop(0)
        dt = self.vehicle["physics_step"]
        inertia = np.array(self.vehicle["inertia"])
        for _ in range(round(self.vehicle["control_step"] / dt)):
            missing = np.sqrt(command) - self.roots
            self.roots += np.where(missing > 0.0, *self.motor_gains) * dt * missing
            gyroscopic = np.cross(self.body_rates, inertia * self.body_rates)
            moment = self.arms @ self.roots**2 - gyroscopic
            acceleration = np.sum(self.roots**2) / self.vehicle["mass"]
            self.velocity += dt * self.rotation[:, 2] * acceleration
            self.velocity[2] -= dt * self.vehicle["gravity"]
            self.body_rates += dt * moment / inertia
            self.position += dt * self.velocity

            # Turn by the exponential of the rotation vector dt ω (Rodrigues' formula).
            turn = np.cross(np.eye(3), dt * self.body_rates)
            angle = dt * np.linalg.norm(self.body_rates)
            half = np.sinc(angle / 2 / np.pi) ** 2 / 2
            self.rotation = self.rotation @ (
                np.eye(3) + np.sinc(angle / np.pi) * turn + half * turn @ turn
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "agents", nargs="+", metavar="ZIP", help="from a training, or one that sb3_quad contains"
    )
    arguments = parser.parse_args()

    for path in arguments.agents:
        model = PPO.load(path, device="cpu")
        if not hasattr(model, "flight_settings"):
            sys.exit(
                f"{path}: does not say how its agent flies (flight_settings); "
                "sb3-quad train writes that into its zips"
            )
        settings = model.flight_settings
        if settings.get("action", "thrusts") != "thrusts":
            sys.exit(f"{path}: commands body rates, and this script flies rotor thrusts")
        observation = Observation(settings)
        action = np.zeros(4)
        # The target is the origin.
        quadcopter = Quadcopter(settings["vehicle"], position=np.array([3.0, -4.0, 2.0]))
        for _ in range(round(15.0 / settings["vehicle"]["control_step"])):
            observed = observation(
                quadcopter.position,
                quadcopter.rotation,
                quadcopter.velocity,
                quadcopter.body_rates,
                action,
            )
            action, _state = model.predict(observed, deterministic=True)
            quadcopter.step(action)
        print(f"{path}: {np.linalg.norm(quadcopter.position):.3f} m from the target after 15 s")
