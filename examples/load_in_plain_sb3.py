"""A trained agent where only Stable-Baselines3 is installed: what it sees is built from what its
zip says, then it flies.

    python examples/load_in_plain_sb3.py sb3_quad/controllers/pretrained/itm-robust.zip

Nothing here imports sb3_quad. Copy `Observation` beside a simulator or a vehicle of your own;
`Quadcopter` stands in for one.
"""

import argparse
import sys

import numpy as np
from stable_baselines3 import PPO

STD = np.repeat(
    [10 / np.sqrt(3), np.sqrt(3), 5.0, 5.0], [3, 9, 3, 3]
)  # of the features, where the zip gives none


class Observation:
    """What the agent sees in an episode, from the state in SI units; to be called once in each
    control step.
    """

    def __init__(self, settings):
        mean, std = settings.get("observation_mean"), settings.get("observation_std")
        self.mean, self.std = (
            np.array(0.0 if mean is None else mean),
            np.array(STD if std is None else std),
        )
        self.ages = settings.get("history") or [0]  # of the frames that it sees, control steps
        self.last_action = settings.get("last_action", False)  # whether a frame ends with it
        self.rule = settings.get("position_integral")
        self.control_step = settings["vehicle"]["control_step"]
        self.frames, self.integral = [], np.zeros(3)  # the latest frame first

    def __call__(self, position, rotation, velocity, body_rates, action):
        """Float32 (18,) or more: features, scaled, with the action before them, of the present and
        of earlier control steps.

        :param position: relative to the target, world frame, z up, m.
        :param rotation: matrix (3, 3), body to world; ``velocity``: world frame, m/s;
            ``body_rates``: body frame, rad/s.
        :param action: the agent's one before, (4,); zeros at the start.
        """
        velocity, rule = rotation.T @ velocity, self.rule
        if (
            rule
            and self.frames
            and np.linalg.norm(position) < rule["distance"]
            and np.linalg.norm(velocity) < rule["speed"]
        ):
            self.integral += rule["gain"] * self.control_step * position
            self.integral = self.integral.clip(-rule["limit"], rule["limit"])
        features = np.concatenate(
            [position + self.integral, rotation.T.ravel(), velocity, body_rates]
        )
        frame = np.concatenate(
            [(features - self.mean) / self.std, np.clip(action, -1, 1)[: 4 * self.last_action]]
        )
        self.frames = [frame, *self.frames[: self.ages[-1]]]
        seen = [
            self.frames[age] if age < len(self.frames) else np.zeros_like(frame)
            for age in self.ages
        ]
        return np.concatenate(seen).astype(np.float32)


class Quadcopter:
    """The vehicle of the zip in still air, at first level and at rest."""

    def __init__(self, vehicle, position):
        self.vehicle, self.position, self.rotation = vehicle, position, np.eye(3)
        self.velocity, self.body_rates = np.zeros(3), np.zeros(3)
        same = vehicle.get(
            "motor_gain"
        )  # in zips from before rotors could slow down at a rate of their own
        self.motor_gains = [vehicle.get(f"motor_gain_{which}", same) for which in ("up", "down")]
        x, y = np.transpose(vehicle["rotor_positions"])
        self.arms = np.stack(
            [y, -x, vehicle["moment_thrust_ratio"] * np.array(vehicle["rotor_directions"])]
        )
        hover = vehicle["mass"] * vehicle["gravity"] / 4
        self.low, self.high = hover * np.array(
            vehicle["thrust_limits"]
        )  # thrust of a rotor at -1 and at 1, N
        self.commands, self.roots = (
            vehicle["delay"] * [np.full(4, hover)],
            np.full(4, np.sqrt(hover)),
        )

    def step(self, action):
        """Fly a control step; the roots of the thrusts, as the rotors' speeds, follow the commands
        with a lag.
        """
        self.commands.append(
            (self.low + self.high + (self.high - self.low) * np.clip(action, -1, 1)) / 2
        )
        command, dt, inertia = (
            self.commands.pop(0),
            self.vehicle["physics_step"],
            np.array(self.vehicle["inertia"]),
        )
        for _ in range(round(self.vehicle["control_step"] / dt)):
            missing = np.sqrt(command) - self.roots
            self.roots += np.where(missing > 0.0, *self.motor_gains) * dt * missing
            moment = self.arms @ self.roots**2 - np.cross(
                self.body_rates, inertia * self.body_rates
            )
            self.velocity += dt * (
                self.rotation[:, 2] * np.sum(self.roots**2) / self.vehicle["mass"]
            )
            self.velocity[2] -= dt * self.vehicle["gravity"]
            self.body_rates += dt * moment / inertia
            self.position += dt * self.velocity
            x, y, z = dt * self.body_rates
            turn, angle = (
                np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]),
                np.sqrt(x * x + y * y + z * z),
            )
            half = np.sinc(angle / 2 / np.pi) ** 2 / 2
            self.rotation = self.rotation @ (
                np.eye(3) + np.sinc(angle / np.pi) * turn + half * turn @ turn
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "agents", nargs="+", metavar="ZIP", help="that training left, or that comes with sb3_quad"
    )
    arguments = parser.parse_args()

    for path in arguments.agents:
        model = PPO.load(path, device="cpu")
        if not hasattr(model, "flight_settings"):
            sys.exit(
                f"{path}: does not say how its agent flies (flight_settings); sb3-quad train writes that into its zips"
            )
        settings = model.flight_settings
        observation, action = Observation(settings), np.zeros(4)
        quadcopter = Quadcopter(
            settings["vehicle"], position=np.array([3.0, -4.0, 2.0])
        )  # the target is the origin
        for _ in range(round(15.0 / settings["vehicle"]["control_step"])):
            state = (
                quadcopter.position,
                quadcopter.rotation,
                quadcopter.velocity,
                quadcopter.body_rates,
            )
            action, _ = model.predict(observation(*state, action), deterministic=True)
            quadcopter.step(action)
        print(f"{path}: {np.linalg.norm(quadcopter.position):.3f} m from the target after 15 s")
