r"""The thesis's adaptive scaling of the observation: agents with and without it (Fig. 4.7).

    python examples/adaptive_scaling.py PID=pid IL-agent=thesis-imitation \
        RL-agent=thesis-recovery -o adaptive_times.png

An agent stops at an offset from its target, which is the same wherever the target is. Adding that
offset to the position components of μ cancels it. Multiplying those of σ by α (4.3.1, Eq. 4.10),
which is below 1 near the target, makes the last metre seem longer than it is. μ is measured on
flights to targets that nothing else uses. Experts fly unchanged.
"""

import argparse
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.colors import to_hex, to_rgb

from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.algorithms.offset_correction import N_OFFSETS, ROUNDS, hover_offset
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes
from sb3_quad.base.seeds import seed_for
from sb3_quad.base.types import Float32Array, FloatArray
from sb3_quad.cli.output import console
from sb3_quad.envs.simulation.observation import DEFAULT_STD, GROUPS
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.evaluation.controllers import parse_controllers
from sb3_quad.evaluation.evaluate import fly_scenario
from sb3_quad.evaluation.metric_tables import CAPTION, metric_cells, metric_rows
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.tables import Column, Table, colours_of
from sb3_quad.report.scenario_plots import arrivals_plot

POSITION = GROUPS["position"]


def adaptive_factor(distance: npt.ArrayLike) -> FloatArray:
    """α = 0.5 (1 + |r - r_T| / 10 m) (Eq. 4.10), of any shape; distance in m."""
    return 0.5 * (1.0 + np.asarray(distance, dtype=np.float64) / 10.0)


class AdaptiveScaling:
    """A policy with the thesis's scaling; like an SB3 model, it has ``predict``.

    The environment returns s / σ. The policy sees (s - μ) / (α σ) in the position components. The
    distance in α is the observed one, with its noise, so the policy needs only its observation.

    :param policy: an SB3 model, or a function of observations.
    :param mean: position components of μ, (3,), m; zero: only α.
    :param std: σ by which the environment scales, (18,); None: Table A.2.
    """

    def __init__(
        self, policy: Any, mean: npt.ArrayLike = (0.0, 0.0, 0.0), std: npt.ArrayLike | None = None
    ) -> None:
        self.policy = policy
        self.observation_space = getattr(policy, "observation_space", None)
        self.mean = np.asarray(mean, dtype=np.float64)
        if std is None:
            std = DEFAULT_STD
        self.std = np.asarray(std, dtype=np.float64)[POSITION]

    def predict(self, observation: Float32Array, **how: Any) -> tuple[Any, Any]:
        """Query the policy with scaled observations.

        :param observation: (n, 18), as the environment returns them.
        :param how: keywords for the policy's ``predict``.
        """
        position = observation[:, POSITION] * self.std
        factor = adaptive_factor(np.linalg.norm(position, axis=1, keepdims=True))
        adapted = observation.copy()
        adapted[:, POSITION] = (position - self.mean) / (factor * self.std)
        if not hasattr(self.policy, "predict"):
            return self.policy(adapted), None
        actions, state, *_ = self.policy.predict(adapted, **how)
        return actions, state


def measure_mean(
    policy: Any, n_episodes: int = N_OFFSETS, settings: FlightSettings | None = None
) -> FloatArray:
    """Find the position components of μ, (3,), m, with which a policy stops at its target.

    Eq. 4.10 shrinks the offset, too, so it is measured with α in use, and again after each
    correction.

    :raises ConfigError: for a policy that crashes on the way to targets.
    """
    mean = np.zeros(3)
    std = None if settings is None else settings.observation_std
    for number in range(ROUNDS):
        seed = seed_for("offset", number)
        mean = mean - hover_offset(AdaptiveScaling(policy, mean, std), n_episodes, seed, settings)
    return mean


def main() -> None:
    """Measure the offsets, fly, print the table, draw the times."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "controllers", nargs="+", metavar="CONTROLLER", help="as for sb3-quad evaluate"
    )
    parser.add_argument(
        "--scenario",
        default="tracking",
        metavar="NAME",
        help="scenario of the suite thesis (tracking)",
    )
    parser.add_argument(
        "-n", "--n-episodes", type=int, metavar="N", help="instead of the scenario's own number"
    )
    parser.add_argument(
        "-o", "--output", metavar="FILE", help="picture of the times to each tolerance, .png"
    )
    options = parser.parse_args()

    (scenario,) = (
        load_suite("thesis").with_changes([options.scenario], options.n_episodes).scenarios
    )
    plain = {}
    adapted = {}
    for spec in parse_controllers(options.controllers):
        controller = resolve_expert(spec.spec, scenario.nominal_vehicle(), "controller")
        plain[spec.label] = summarise(fly_scenario(controller, scenario, own=spec.observed))
        # An expert sees the true state, so there is no observation to scale.
        if hasattr(controller, "actions"):
            continue
        if spec.own is not None and spec.own.is_extended:
            raise ConfigError(
                f"{spec.label}: sees more than the 18 features; only these can be scaled"
            )
        settings = FlightSettings(vehicle=scenario.nominal_vehicle(), **spec.observed)
        mean = measure_mean(controller, settings=settings)
        print(f"{spec.label}: offset μ = ({mean[0]:.4f}, {mean[1]:.4f}, {mean[2]:.4f}) m")
        scaled = AdaptiveScaling(controller, mean, spec.observed["observation_std"])
        adapted[f"{spec.label} (adaptive)"] = summarise(
            fly_scenario(scaled, scenario, own=spec.observed)
        )
    metrics = plain | adapted
    columns = [Column(label) for label in metrics]
    columns += [Column(name, source="thesis") for name in scenario.published]
    cells = [metric_cells(measured) for measured in metrics.values()]
    rows = metric_rows(scenario, cells, scenario.published.values())
    console().print(Table(columns, rows, title=scenario.heading, caption=CAPTION))
    if options.output:
        # With adaptive scaling, an agent has a lighter shade of its colour.
        colours = colours_of([*plain])
        for label in plain:
            red, green, blue = to_rgb(colours[label])
            light = (0.5 + 0.5 * red, 0.5 + 0.5 * green, 0.5 + 0.5 * blue)
            colours[f"{label} (adaptive)"] = to_hex(light)
        write_bytes(options.output, arrivals_plot(scenario, metrics, colours).png)


if __name__ == "__main__":
    main()
