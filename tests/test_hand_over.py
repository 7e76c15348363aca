"""What a run hands over, by its evaluations."""

from types import SimpleNamespace

import numpy as np
import pytest

from sb3_quad.training.config import TrainingJob, load_config
from sb3_quad.training.hand_over import hand_over
from sb3_quad.training.rivals import TOLERANCE, Flown, with_vehicle
from sb3_quad.training.runs import RunFolder

GOOD, BETTER, RUINED = (mean + np.linspace(-0.5, 0.5, 8) for mean in (-1.0, -0.8, -20.0))
# Better in one flight and worse in another
LUCK = GOOD + np.array([3.0, -3.1, 0, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("first", "results", "wanted", "agent", "is_start", "is_problem"),
    [
        (0, [GOOD, RUINED, BETTER], "best", "best_model.zip", False, False),
        (0, [GOOD, BETTER, RUINED], "best", "best_model.zip", False, False),
        (0, [GOOD, RUINED], "best", "best_model.zip", True, True),
        (0, [GOOD, RUINED], "last", "best_model.zip", True, True),
        (0, [GOOD, LUCK], "best", "best_model.zip", True, False),
        (0, [GOOD, LUCK], "last", "Env.zip", False, False),
        # Without an agent to start from
        (400, [GOOD, RUINED], "best", "best_model.zip", False, False),
        (400, [GOOD, RUINED], "last", "Env.zip", False, False),
    ],
)
def test_a_run_hands_over_its_best_agent_and_none_below_its_start(
    tmp_path, first, results, wanted, agent, is_start, is_problem
):
    run = RunFolder(tmp_path, "Env")
    timesteps = first + 400 * np.arange(len(results))
    survivals = np.array(results) > -10
    np.savez(run.evaluations, timesteps=timesteps, results=results, survivals=survivals)
    handed = hand_over(run, "reward", wanted)
    assert (handed.agent.name, handed.is_start, bool(handed.problem)) == (
        agent,
        is_start,
        is_problem,
    )
    is_last = agent == "Env.zip"
    assert np.all(handed.row["results"] == (results[-1] if is_last else max(results, key=np.mean)))


def test_without_evaluations_the_last_agent_is_handed_over(tmp_path):
    assert hand_over(RunFolder(tmp_path, "Env"), "reward").agent.name == "Env.zip"


@pytest.mark.parametrize(
    ("changes", "flies"),
    [
        ({"vehicle": "crazyflie"}, True),
        ({}, False),
        ({"vehicle": "crazyflie", "vehicles": {"distribution": "raptor"}}, False),
    ],
)
def test_rivals_fly_where_a_vehicle_is_given(changes, flies):
    config = load_config("apg", "QuadStateRecovery-v0", None, {"env_kwargs": changes})
    assert with_vehicle(TrainingJob(config=config)) == flies


@pytest.mark.parametrize(
    ("lost", "missed", "reward", "is_behind"),
    [
        (0, 0, GOOD, False),
        (0, 0, GOOD - 0.1, True),
        (4, 4, BETTER, True),
        (-1, -1, RUINED, False),
        (0, 4, GOOD, True),
        (0, 4, LUCK, True),
        (0, 4, BETTER, True),
        (0, -4, RUINED, False),
        (1, 1, GOOD, False),
    ],
)
def test_who_loses_or_misses_more_is_behind(lost, missed, reward, is_behind):
    def flown(lost, missed, reward):
        flights = np.arange(100)
        return Flown(
            "agent",
            SimpleNamespace(
                survival=flights >= 10 + lost,
                success=flights >= 10 + missed,
                reward=reward,
            ),
        )

    other = flown(0, 0, GOOD)
    assert flown(lost, missed, reward).is_behind(other) == is_behind
    if is_behind:
        assert not other.is_behind(flown(lost, missed, reward))


@pytest.mark.parametrize(
    ("slower", "margin", "is_behind"),
    [(2.0, 0.2, True), (np.nan, 0.2, True), (1.2, 0.2, False), (2.0, 0.0, False)],
)
def test_training_does_not_begin_from_who_settles_much_later(slower, margin, is_behind):
    def flown(time, reward):
        times = {TOLERANCE: np.array([time, np.nan])}
        same = np.ones(2)
        flights = SimpleNamespace(survival=same, success=same, reward=reward, settling_time=times)
        return Flown("agent", flights)

    agent, other = flown(slower, np.array([-1.0, -1.0])), flown(1.0, np.array([-1.1, -1.2]))
    assert agent.is_behind(other, margin) == is_behind
    # Nobody is late beside one that never settles.
    assert not agent.is_behind(flown(np.nan, np.array([-1.1, -1.2])), margin)
