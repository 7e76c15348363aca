"""Frames of an observation: earlier features, the action before them, and the integral of the
position error.
"""

import gymnasium
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import sb3_quad  # noqa: F401  (registers the environments)
from sb3_quad.envs.simulation.observation import DEFAULT_STD
from sb3_quad.envs.vec_env import QuadcopterVecEnv

LIMIT = 40


def flown(n, steps, **keywords):
    """Observations before and after each step, actions, dones, and infos of the last."""
    env = QuadcopterVecEnv(n, task="state_recovery", seed=3, max_episode_steps=LIMIT, **keywords)
    actions = np.random.default_rng(0).uniform(-1.5, 1.5, (steps, n, 4)).astype(np.float32)
    observations, dones, last = [env.reset()], [], []
    for action in actions:
        observation, _, done, infos = env.step(action)
        observations.append(observation)
        dones.append(done)
        last.append([info.get("terminal_observation") for info in infos])
    return np.array(observations), actions, np.array(dones), last


@given(st.sets(st.integers(1, 50), max_size=4), st.booleans())
def test_a_frame_is_what_was_seen_then_and_the_action_before_it(ages, last_action):
    history = [0, *sorted(ages)]
    n, steps = 3, 2 * LIMIT + 5
    plain, actions, dones, plain_last = flown(n, steps)
    seen, _, _, seen_last = flown(n, steps, history=history, last_action=last_action)
    size = 18 + 4 * last_action
    assert seen.shape[2] == len(history) * size
    for row in range(n):
        begin = 0  # of the episode
        for step in range(steps + 1):
            ended = step > 0 and dones[step - 1, row]
            if ended:  # the last observation of the episode that ended, then the first of the next
                check_frames(
                    seen_last[step - 1][row],
                    plain_last[step - 1][row],
                    plain,
                    actions,
                    row,
                    begin,
                    step,
                    history,
                    size,
                )
                begin = step
            check_frames(
                seen[step, row], plain[step, row], plain, actions, row, begin, step, history, size
            )


def check_frames(seen, now, plain, actions, row, begin, step, history, size):
    for number, age in enumerate(history):
        frame = seen[number * size : (number + 1) * size]
        then = step - age
        if then < begin:
            assert not frame.any()
            continue
        np.testing.assert_array_equal(frame[:18], now if age == 0 else plain[then, row])
        if size > 18:
            expected = np.zeros(4) if then == begin else np.clip(actions[then - 1, row], -1, 1)
            np.testing.assert_array_equal(frame[18:], expected.astype(np.float32))


def test_the_integral_is_that_of_what_is_observed_near_the_target():
    gain, distance, speed, limit = 0.8, 1.5, 2.0, 0.4
    n, steps = 20, 3 * LIMIT
    own = {"gain": gain, "distance": distance, "speed": speed, "limit": limit}
    plain, _, dones, _ = flown(n, steps)
    seen, _, _, _ = flown(n, steps, position_integral=own)
    integral, used = np.zeros((n, 3)), 0
    for step in range(steps + 1):
        features = plain[step] * DEFAULT_STD
        if step > 0:
            integral[dones[step - 1]] = 0.0
            near = (np.linalg.norm(features[:, :3], axis=1) < distance) & (
                np.linalg.norm(features[:, 12:15], axis=1) < speed
            )
            near &= ~dones[step - 1]
            used += near.sum()
            integral[near] = np.clip(integral + 0.01 * gain * features[:, :3], -limit, limit)[near]
        np.testing.assert_allclose(
            seen[step, :, :3] * DEFAULT_STD[:3], features[:, :3] + integral, atol=2e-5
        )
        np.testing.assert_array_equal(seen[step, :, 3:], plain[step, :, 3:])
    assert used > 50


def test_a_snapshot_keeps_the_frames_and_looking_changes_nothing():
    env = QuadcopterVecEnv(
        5,
        seed=0,
        history=[0, 2, 7],
        last_action=True,
        position_integral={},
        randomize={"mass": [0.9, 1.1]},
    )
    env.reset()
    actions = np.random.default_rng(0).uniform(-0.2, 0.3, (60, 5, 4)).astype(np.float32)
    for action in actions[:30]:
        seen = env.step(action)[0]
        for _ in range(2):
            np.testing.assert_array_equal(env.batch.observe(), seen)
    saved = env.batch.snapshot()
    ahead = [env.step(action)[0] for action in actions[30:]]
    env.batch.restore(saved)
    np.testing.assert_array_equal(ahead, [env.step(action)[0] for action in actions[30:]])


def test_the_observation_space_has_room_for_the_frames():
    keywords = {"history": [0, 1, 4], "last_action": True}
    single = gymnasium.make("QuadTargetTracking-v0", **keywords)
    assert single.observation_space.shape == (66,)
    assert single.reset(seed=0)[0].shape == (66,)
    assert single.unwrapped.step(np.zeros(4))[0].shape == (66,)
    single.close()
