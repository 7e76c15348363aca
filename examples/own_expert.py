"""An expert of your own teaches an agent.

It is the geometric controller while the vehicle is tilted or turning, and otherwise the thesis's
PID.

    python examples/own_expert.py

An expert answers with actions in [-1, 1], (n, 4), to the true state of n vehicles: docs/experts.md.
On the command line the same class teaches as `PYTHONPATH=examples sb3-quad train --algo dagger
--expert own_expert:SwitchingExpert`.
"""

import argparse

import numpy as np

from sb3_quad import DAgger, GeometricExpert, PIDExpert, QuadcopterVecEnv, fly
from sb3_quad.experts.protocol import Expert


class SwitchingExpert(Expert):
    """Recovers with one controller and travels with the other."""

    def __init__(self, vehicle="itm"):
        super().__init__(vehicle)
        self.geometric, self.pid = GeometricExpert(vehicle), PIDExpert(vehicle)

    def actions(self, state):
        """Float32 (n, 4), for the true state of n vehicles."""
        # The angle between the body's z axis and the world's is below 20 degrees.
        upright = state.rotation[:, 2, 2] > np.cos(np.radians(20.0))
        # rad/s
        calm = np.linalg.norm(state.body_rates, axis=1) < 1.0
        return np.where(
            (upright & calm)[:, None], self.pid.actions(state), self.geometric.actions(state)
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--timesteps",
        type=int,
        default=600_000,
        help="transitions, over all environments (%(default)s)",
    )
    arguments = parser.parse_args()

    expert = SwitchingExpert()
    env = QuadcopterVecEnv(240, task="state_recovery", max_episode_steps=500, seed=0)
    model = DAgger("MlpPolicy", env, expert=expert, seed=0)
    model.learn(arguments.timesteps)
    for name, controller in (("PID", PIDExpert()), ("own expert", expert), ("agent", model)):
        flights = fly(controller, "state_recovery", n_episodes=480, seed=1_000_000)
        print(
            f"{name}: success {flights.success.mean():.1%}, survival {flights.survival.mean():.1%}"
        )
