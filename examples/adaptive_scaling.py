"""The scaling of the observation that the thesis adapts while flying (4.3.1, Eq. 4.10): agents with
and without it (Fig. 4.7).

    python examples/adaptive_scaling.py PID=pid IL-agent=thesis-imitation RL-agent=thesis-recovery
    -o adaptive_times.png

An agent hovers beside its target, by the same vector wherever the target is. Moving the position
components of μ by that vector cancels it; multiplying those of σ by α, below 1 near the target,
lets the last metre seem longer than it is. μ is measured on flights to targets that are used for
nothing else. Experts fly as they are.
"""

import argparse
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_quad.algorithms.offset_correction import N_OFFSETS, ROUNDS, hover_offset
from sb3_quad.base.arrays import Float32Array, FloatArray
from sb3_quad.base.colours import colours_of
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import write_bytes
from sb3_quad.base.seeds import seed_for
from sb3_quad.cli.output import console
from sb3_quad.controllers.resolve import resolve_expert
from sb3_quad.evaluation.controllers import parse_controllers
from sb3_quad.evaluation.evaluate import fly_scenario
from sb3_quad.evaluation.metric_tables import CAPTION, metric_cells, metric_rows
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.tables import Column, Table
from sb3_quad.report.scenario_plots import arrivals_plot
from sb3_quad.simulation.observation import DEFAULT_STD, GROUPS
from sb3_quad.simulation.settings import FlightSettings

POSITION = GROUPS["position"]


def adaptive_factor(distance: npt.ArrayLike) -> FloatArray:
    """α = 0.5 (1 + |r - r_T| / 10 m) (Eq. 4.10), of any shape; distance in m."""
    return 0.5 * (1.0 + np.asarray(distance, dtype=np.float64) / 10.0)


class AdaptiveScaling:
    """A policy behind the thesis's scaling, asked by ``predict`` as an SB3 model is.

    In the position components it shows the policy (s - μ) / (α σ), where s / σ is what the
    environment gives. The distance in α is the observed one, noise and all, so that a policy needs
    nothing but its observation.

    :param policy: an SB3 model, or a function of observations.
    :param mean: position components of μ, (3,), m; zero: only α.
    :param std: σ that the environment scales by, (18,); None: Table A.2.
    """

    def __init__(
        self, policy: Any, mean: npt.ArrayLike = (0.0, 0.0, 0.0), std: npt.ArrayLike | None = None
    ) -> None:
        self.policy, self.observation_space = policy, getattr(policy, "observation_space", None)
        self.mean = np.asarray(mean, dtype=np.float64)
        self.std = np.asarray(DEFAULT_STD if std is None else std, dtype=np.float64)[POSITION]

    def predict(self, observation: Float32Array, **how: Any) -> tuple[Any, Any]:
        """The policy's answer to scaled observations, (n, 18), in physical terms those that the
        environment gives.

        :param how: for the policy's own ``predict``.
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
    policy: Any, n_flights: int = N_OFFSETS, settings: FlightSettings | None = None
) -> FloatArray:
    """The position components of μ, (3,), m, with which a policy behind :class:`AdaptiveScaling`
    stops at its target.

    Eq. 4.10 shrinks the offset, too, so it is measured with α at work, and again after each
    correction.

    :raises ConfigError: a policy that crashes on the way to targets.
    """
    mean = np.zeros(3)
    for number in range(ROUNDS):
        seed, std = (
            seed_for("offset", number),
            None if settings is None else settings.observation_std,
        )
        mean = mean - hover_offset(AdaptiveScaling(policy, mean, std), n_flights, seed, settings)
    return mean


def main() -> None:
    """Measure, fly, print the table, draw the times."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "controllers", nargs="+", metavar="CONTROLLER", help="as for sb3-quad evaluate"
    )
    parser.add_argument(
        "--scenario", default="tracking", metavar="NAME", help="of the suite thesis (tracking)"
    )
    parser.add_argument(
        "--episodes", type=int, metavar="N", help="instead of the scenario's own number"
    )
    parser.add_argument(
        "-o", "--output", metavar="FILE", help="picture of the times to each tolerance, .png"
    )
    options = parser.parse_args()

    (scenario,) = load_suite("thesis").with_changes([options.scenario], options.episodes).scenarios
    plain, adapted = {}, {}
    for spec in parse_controllers(options.controllers):
        controller = resolve_expert(spec.spec, scenario.nominal_vehicle(), "controller")
        plain[spec.label] = summarise(fly_scenario(controller, scenario, own=spec.observed)[0])
        if hasattr(controller, "actions"):  # an expert, which sees the true state
            continue
        if spec.own is not None and spec.own.is_extended:
            raise ConfigError(
                f"{spec.label}: sees more than the 18 features, which alone are scaled"
            )
        settings = FlightSettings(vehicle=scenario.nominal_vehicle(), **spec.observed)
        mean = measure_mean(controller, settings=settings)
        print(f"{spec.label}: offset μ = ({', '.join(f'{x:.4f}' for x in mean)}) m")
        scaled = AdaptiveScaling(controller, mean, spec.observed["observation_std"])
        adapted[f"{spec.label} (adaptive)"] = summarise(
            fly_scenario(scaled, scenario, own=spec.observed)[0]
        )
    metrics = plain | adapted
    columns = [
        *map(Column, metrics),
        *(Column(name, source="thesis") for name in scenario.reference),
    ]
    rows = metric_rows(
        scenario, [metric_cells(each) for each in metrics.values()], scenario.reference.values()
    )
    console().print(Table(columns, rows, title=scenario.heading, caption=CAPTION))
    if options.output:
        write_bytes(options.output, arrivals_plot(scenario, metrics, colours_of([*metrics])).png)


if __name__ == "__main__":
    main()
