"""Fly an agent as PX4's module mc_nn_control computes it, and at several rates.

    python examples/px4_flights.py x500-px4
    python examples/px4_flights.py x500-px4 --rates 100 200 400 1000

Without --rates, the TensorFlow Lite file of `sb3-quad export --format px4` flies beside its zip:
in TensorFlow Lite Micro, in an arena of the module's size, with the inputs that the module fills
and the outputs that it clips and orders. Both fly the same recoveries and targets, with the same
noise. With --rates, the zip flies at these calls a second; a command acts one call later, or
after --delay seconds.
"""

import argparse
import sys
from typing import Any

import numpy as np

from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pretrained import agent_path
from sb3_quad.agents.zips import load_model
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vehicles.vehicle import first_vehicle, load_vehicle
from sb3_quad.evaluation.fleets import Fleet
from sb3_quad.evaluation.flights import fly
from sb3_quad.export.policy import export_policy
from sb3_quad.export.px4 import load_px4

TASKS = ("state_recovery", "target_tracking")
SECONDS = 15.0


class Module:
    """The module with a network, as a function from observations to actions.

    :param agent: the zip.
    :param settings: how it flies.
    """

    def __init__(self, agent: str, settings: FlightSettings) -> None:
        exported = export_policy(agent, "px4")
        print(exported.metadata["check"])
        self.vehicle = first_vehicle(settings.vehicle)
        self.call, _ = load_px4(exported.content, 0, self.vehicle)
        row = QuadcopterBatch(1, settings, n_threads=1)
        self.mean = row.mean[:, 0]
        self.std = row.std[:, 0]

    def __call__(self, observations: Any) -> Any:
        """Return the actions (n, 4) for observations (n, 18)."""
        features = observations * self.std + self.mean
        thrusts, _ = self.call(features.astype(np.float32))
        return self.vehicle.thrust_to_action(thrusts.astype(np.float64))


def report(label: str, controller: Any, flights: int, seed: int, **settings: Any) -> None:
    """Fly both tasks, and print their success and how close and fast they are."""
    for task in TASKS:
        flown = fly(controller, task, flights, seed, **settings)
        error = np.median(flown.final_error)
        times = flown.settling_time[0.1]
        print(
            f"{label}, {task}: {100.0 * flown.success.mean():.2f} % of {flights} succeed,"
            f" {100.0 * flown.survival.mean():.2f} % survive, settled within 0.1 m after"
            f" {np.nanmean(times):.2f} s, final error {1000.0 * error:.2f} mm (median)"
        )


def report_heading(zip_model: Any, settings: FlightSettings, flights: int, seed: int) -> None:
    """Print where the x axis points after recoveries of 10 s."""
    changed = settings.with_changes(task="state_recovery", task_kwargs=None, randomize=None)
    fleet = Fleet(row_seeds(seed, flights), changed)
    observation = fleet.begin({})
    for _ in range(1000):
        observation, _, _ = fleet.step(zip_model.predict(observation, deterministic=True)[0])
    x_axis = fleet.true_state().rotation[:, :, 0]
    headings = np.degrees(np.arctan2(x_axis[:, 1], x_axis[:, 0]))
    print(f"zip, heading after 10 s: {headings.min():.1f} to {headings.max():.1f} degrees")


def main(arguments: list[str]) -> None:
    """Read the command line, and fly."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("agent", type=agent_path, help="a zip, a run folder or a name")
    parser.add_argument("--flights", type=int, default=960, help="of each task (960)")
    parser.add_argument("--seed", type=int, default=61, help="(61)")
    parser.add_argument("--rates", type=float, nargs="+", help="calls a second of the zip")
    parser.add_argument("--delay", type=float, default=0.0, help="s, at least one call (0)")
    options = parser.parse_args(arguments)
    settings, _ = agent_settings(options.agent)
    seen = {"features": settings.features, "noise": settings.noise}
    vehicle = load_vehicle(first_vehicle(settings.vehicle))
    zip_model = load_model(options.agent)
    if not options.rates:
        controllers = {"zip": zip_model, "tflite-micro": Module(options.agent, settings)}
        for label, controller in controllers.items():
            report(label, controller, options.flights, options.seed, vehicle=vehicle, **seen)
        report_heading(zip_model, settings, options.flights, options.seed)
        return
    for rate in options.rates:
        step = 1.0 / rate
        steps = {
            "control_step": step,
            "physics_step": min(vehicle.physics_step, step),
            "delay": max(round(options.delay * rate), 1),
        }
        report(
            f"{rate:g} Hz",
            zip_model,
            options.flights,
            options.seed,
            vehicle=vehicle.model_copy(update=steps),
            max_episode_steps=round(SECONDS * rate),
            **seen,
        )


if __name__ == "__main__":
    main(sys.argv[1:])
