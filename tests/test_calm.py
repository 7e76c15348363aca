"""Calm: what the metrics of hover count, and that reward and APG's cost mean the same."""

import numpy as np
import pytest
import torch as th

from sb3_quad.envs.flight_cost import FlownStates, calm_cost
from sb3_quad.envs.simulation.state import BODY_RATES, POSITION, QUATERNION, STATE, STATE_SIZE
from sb3_quad.envs.simulation.state import QuadcopterState as State
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.hooks import Course
from sb3_quad.evaluation.hover import BRAKING, HOVERED, LEAST, Hover

TILT, RATE, CHANGE = 10.0, 2.0, 0.02  # degrees, rad/s, of each command and control step
STEP = load_vehicle("itm").control_step


def hovered(distances, flying=True):
    """The metrics of one flight: calm of the constants above while it is near, wild elsewhere."""
    course = Course(np.zeros((0, 3)), 0.5)
    hook = Hover(course)
    array = np.zeros((STATE_SIZE, 1))
    course.on_start(State(array), load_vehicle("itm"))
    hook.on_start(State(array), load_vehicle("itm"))
    for step, distance in enumerate(distances, 1):
        half = np.radians(TILT if distance <= 0.1 else 80.0) / 2
        array[QUATERNION, 0] = np.cos(half), 0.0, np.sin(half), 0.0
        array[POSITION, 0] = distance, 0.0, 0.0
        array[BODY_RATES, 0] = 0.0, 0.0, RATE if distance <= 0.1 else 50.0
        actions = np.full((1, 4), CHANGE / 2 if step % 2 else -CHANGE / 2, np.float32)
        hook.after_step(step, State(array), actions, np.array([flying]))
    results = hook.results()
    return [results[name][0] for name in HOVERED]


def near(seconds):
    return [0.05] * round(seconds / STEP)


@pytest.mark.parametrize("before", [[], [3.0] * 50, [*near(4.0), 0.11]])
def test_only_the_hover_until_the_end_counts(before):
    measured = hovered([*before, *near(BRAKING + LEAST)])
    np.testing.assert_allclose(measured, [RATE, TILT, CHANGE / STEP], rtol=1e-6)


@pytest.mark.parametrize(
    ("distances", "flying"),
    [
        (near(BRAKING + LEAST - STEP), True),
        ([*near(10.0), 0.2], True),
        (near(10.0), False),
    ],
    ids=["too short", "ends elsewhere", "lost"],
)
def test_what_does_not_hover_has_no_metrics(distances, flying):
    assert np.isnan(hovered(distances, flying)).all()


def flown(env, actions):
    """Rewards and states of a flight near its target, whatever the kind of environment."""
    env.reset()
    rewards, states = [], []
    for action in actions:
        rewards.append(env.step(action)[1])
        states.append(env.true_state().array.copy())
    return np.array(rewards).reshape(len(actions), -1), np.stack(states)


def costs(states, actions):
    parts = th.split(th.from_numpy(states), [*STATE.values()], dim=1)
    parts = [part.transpose(1, 2) for part in parts]
    return calm_cost(FlownStates._make([*parts, th.from_numpy(actions)]), STEP).numpy()


def test_the_reward_and_the_cost_of_apg_have_the_same_term():
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (12, 3, 4)).astype(np.float32)
    kwargs = {"task": "state_recovery", "noise": 0.0, "seed": 0}
    plain, states = flown(QuadcopterVecEnv(3, **kwargs), actions)
    calm, _ = flown(QuadcopterVecEnv(3, **kwargs, task_kwargs={"calm_cost": 0.01}), actions)
    np.testing.assert_allclose(plain - calm, 0.01 * costs(states, actions), atol=1e-5)
