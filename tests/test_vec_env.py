"""QuadcopterVecEnv: the same flights as QuadcopterEnv, rows apart from each other, and
Stable-Baselines3's interface.
"""

import warnings

import numba
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor

from sb3_quad import envs
from sb3_quad.base.compiled import compile_notice
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.process import print_once
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.experts.pid import PIDExpert

TASKS = ("target_tracking", "state_recovery")
MIXTURE = {"target_tracking": 1.0, "state_recovery": 2.0}


def fly(env, steps, actions=None):
    """Observations, rewards and dones of ``steps`` steps with the same random actions for
    the same number of rows.
    """
    if actions is None:
        actions = np.random.default_rng(0).uniform(-1, 1, (steps, env.num_envs, 4))
    taken = [env.step(action.astype(np.float32))[:3] for action in actions]
    return [np.array(each) for each in zip(*taken, strict=True)]


# --- whole episodes, compared with PyBullet


def episode_of_one(env, seed, choose, limit):
    observation, _ = env.reset(seed=seed)
    rewards, terminated, info = [], False, {}
    for _ in range(limit):
        observation, reward, terminated, _, info = env.step(choose(env.true_state()))
        rewards.append(reward)
        if terminated:
            break
    return np.array(rewards), observation, terminated, info


def first_episodes(env, choose, limit):
    """Rewards up to the end, last info, of the first episode of each row."""
    env.reset()
    rewards, infos = [[] for _ in range(env.num_envs)], {}
    for _ in range(limit):
        _, reward, done, info = env.step(choose(env.true_state()))
        for row in set(range(env.num_envs)) - set(infos):
            rewards[row].append(reward[row])
            if done[row]:
                infos[row] = info[row]
    return [np.array(each) for each in rewards], infos


@pytest.mark.parametrize("controller", ["pid", "random"])
@pytest.mark.parametrize("task", TASKS)
def test_whole_episodes_are_pybullets(task, controller):
    n, limit = 4, 700
    batch = QuadcopterVecEnv(n, task=task, noise=0.0, seed=20, max_episode_steps=limit)
    single = envs.QuadcopterEnv(task=task, noise=0.0)
    table = np.random.default_rng(1).uniform(-1, 1, (n, limit, 4)).astype(np.float32)
    pid = PIDExpert()
    counts = {"batch": 0}

    def choose_all(state):
        if controller == "pid":
            return pid.actions(state)
        counts["batch"] += 1
        return table[:, counts["batch"] - 1]

    rewards, infos = first_episodes(batch, choose_all, limit)
    for row in range(n):
        flown = iter(table[row])
        choose = (
            (lambda state: pid.actions(state)[0])
            if controller == "pid"
            else (lambda state, flown=flown: next(flown))
        )
        expected, observation, terminated, info = episode_of_one(
            single, row_seeds(20, n)[row], choose, limit
        )
        assert len(expected) == len(rewards[row])
        np.testing.assert_allclose(rewards[row], expected, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(infos[row]["terminal_observation"], observation, atol=2e-6)
        for name in ("is_success", "survival", "collision", "out_of_range"):
            assert infos[row][name] == info[name]
        assert infos[row]["TimeLimit.truncated"] == info["survival"] == (not terminated)
        assert infos[row]["episode"]["l"] == len(expected)
        assert infos[row]["episode"]["r"] == pytest.approx(expected.sum(), abs=1e-5)
        assert infos[row]["distance"] == pytest.approx(info["distance"], abs=1e-8)
    single.close()


# --- rows apart from each other


def test_a_row_is_what_its_seed_alone_is():
    n, steps = 200, 300
    env = QuadcopterVecEnv(n, task=MIXTURE, seed=3, max_episode_steps=150)
    env.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (steps, n, 4)).astype(np.float32)
    observations, rewards, dones = fly(env, steps, actions)
    for row in (0, 63, 64, 199):
        alone = QuadcopterVecEnv(1, task=MIXTURE, max_episode_steps=150)
        alone.batch.seed([row_seeds(3, n)[row]])
        alone.reset()
        observation, reward, done = fly(alone, steps, actions[:, [row]])
        np.testing.assert_array_equal(observation[:, 0], observations[:, row])
        np.testing.assert_array_equal(reward[:, 0], rewards[:, row])
        np.testing.assert_array_equal(done[:, 0], dones[:, row])


@pytest.mark.parametrize("n", [193, 700])
def test_results_do_not_depend_on_the_number_of_threads(n):
    flights = []
    for threads in (1, 2, 5):
        env = QuadcopterVecEnv(n, task=MIXTURE, seed=1, n_threads=threads, max_episode_steps=60)
        flights.append([env.reset(), *fly(env, 150), env.true_state().array.copy()])
    for flight in flights[1:]:
        for got, expected in zip(flight, flights[0], strict=True):
            np.testing.assert_array_equal(got, expected)


def test_seed_gives_the_same_again_and_without_it_episodes_go_on():
    env = QuadcopterVecEnv(5, seed=0)
    first, second = env.reset(), env.reset()
    assert not np.allclose(first, second)
    assert env.seed(0) == row_seeds(0, 5)
    np.testing.assert_array_equal(env.reset(), first)
    np.testing.assert_array_equal(env.reset(), second)


# --- ends of episodes


def test_compiling_is_told_where_something_is_compiled_and_nowhere_else(capsys):
    @numba.njit
    def doubled(x):
        return x + x

    print_once.cache_clear()
    with compile_notice():
        pass
    assert capsys.readouterr().err == ""
    with compile_notice():
        assert (doubled(1), doubled(1.0)) == (2, 2.0)  # compiled twice
    said = capsys.readouterr().err
    assert said.count("sb3_quad: compiling") == said.count("sb3_quad: compiled in 0 s\n") == 1
    with compile_notice():
        doubled(1)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("task", "distance", "tilt", "succeeds"),
    [
        ("target_tracking", 0.09, 40.0, True),
        ("target_tracking", 0.11, 0.0, False),
        ("state_recovery", 0.24, 9.0, True),
        ("state_recovery", 0.26, 9.0, False),
        ("state_recovery", 0.24, 11.0, False),
    ],
)
def test_success_is_to_be_at_the_target_in_the_end(task, distance, tilt, succeeds):
    batch, single = QuadcopterVecEnv(2, task, max_episode_steps=1), envs.QuadcopterEnv(task)
    quaternion = [np.cos(np.radians(tilt / 2)), np.sin(np.radians(tilt / 2)), 0.0, 0.0]
    start = {
        "position": [0, 0, 15],
        "quaternion": quaternion,
        "velocity": [0, 0, 0],
        "body_rates": [0, 0, 0],
    }
    single.reset(options={"state": start, "target": [0, 0, 15 + distance]})
    batch.reset()
    for name, value in start.items():
        getattr(batch.true_state(), name)[:] = value
    batch.set_target([0, 0, 15 + distance])
    info = single.step(np.zeros(4))[4]
    for each in (info, *batch.step(np.zeros((2, 4)))[3]):
        assert each["survival"] and each["is_success"] == succeeds
    single.close()


def test_terminal_observations_are_rows_own_and_stay():
    env = QuadcopterVecEnv(130, seed=0, max_episode_steps=30)
    env.reset()
    for _ in range(29):
        env.step(np.zeros((130, 4)))
    infos = list(env.step(np.zeros((130, 4)))[3])
    terminal = np.array([info["terminal_observation"] for info in infos])
    assert len(np.unique(terminal.round(4), axis=0)) == 130
    kept = terminal.copy()
    infos_after = env.step(np.ones((130, 4)))[3]
    assert not any(infos_after)
    for _ in range(29):
        env.step(np.ones((130, 4)))
    np.testing.assert_array_equal(np.array([info["terminal_observation"] for info in infos]), kept)


def test_infos_say_the_same_whenever_somebody_looks():
    at_once, later = (
        QuadcopterVecEnv(20, "state_recovery", seed=0, max_episode_steps=25) for _ in range(2)
    )
    first, last = [], []
    for env in (at_once, later):
        env.reset()
    for _ in range(60):
        infos = at_once.step(np.zeros((20, 4)))[3]
        first.append([infos[row] for row in (*range(1, 20), -20)])
        last.append(later.step(np.zeros((20, 4)))[3])
    for looked, infos in zip(first, last, strict=True):
        assert infos[19] is infos[-1] is [*infos][19]
        for info, same in zip(looked, [*infos[1:], infos[0]], strict=True):
            assert info.keys() == same.keys()
            assert info.get("episode", {}).get("r") == same.get("episode", {}).get("r")
            assert info.get("distance") == same.get("distance")
            np.testing.assert_array_equal(
                info.get("terminal_observation"), same.get("terminal_observation")
            )
    assert sum(bool(info) for looked in first for info in looked) >= 40


def test_out_of_range_ends():
    env = QuadcopterVecEnv(2, noise=0.0, seed=0)
    env.reset()
    env.set_target((100.0, 0.0, 15.0), indices=[1])
    _, rewards, dones, infos = env.step(np.zeros((2, 4)))
    assert dones.tolist() == [False, True]
    assert (
        infos[1]["out_of_range"]
        and not infos[1]["is_success"]
        and not infos[1]["TimeLimit.truncated"]
    )
    assert rewards[1] == pytest.approx(-15.3, abs=0.01) and rewards[0] > -0.1


# --- what users set


def test_setters_reach_the_rows_they_name():
    env = QuadcopterVecEnv(4, seed=0)
    env.reset()
    env.set_target((1, 2, 3))
    np.testing.assert_array_equal(env.target, np.tile([1.0, 2, 3], (4, 1)))
    env.env_method("set_target", (0, 0, 9), indices=[1, 3])
    np.testing.assert_array_equal(env.get_attr("target", [0, 1]), [(1, 2, 3), (0, 0, 9)])
    env.set_attr("target", np.arange(12.0).reshape(4, 3))
    np.testing.assert_array_equal(env.target, np.arange(12.0).reshape(4, 3))
    for indices in ([], np.zeros(4, np.bool_)):
        env.set_target((0, 0, 15), indices=indices)
        env.set_reference((0, 0, 15), heading=1.0, indices=indices)
        env.set_wrench((1, 0, 0), indices=indices)
        env.set_wind((1, 0, 0), indices=indices)
        env.set_noise(0.5, indices=indices)
    np.testing.assert_array_equal(env.target, np.arange(12.0).reshape(4, 3))
    assert not env.wrench.any() and not env.wind.any() and (env.noise == 0.05).all()
    env.set_noise(0.0)
    assert env.get_attr("noise") == [0.0] * 4
    env.set_attr("noise", 0.1, indices=2)
    assert env.get_attr("noise") == [0.0, 0.0, 0.1, 0.0]
    assert [state.n for state in env.env_method("true_state")] == [1] * 4
    assert env.env_is_wrapped(VecMonitor) == [False] * 4
    env.set_wrench(force=(0.0, 2.0, 0.0), indices=[1])
    assert [wrench[1] for wrench in env.get_attr("wrench", [0, 1])] == [0.0, 2.0]


def test_its_episodes_are_a_monitors():
    env = QuadcopterVecEnv(3, seed=0, max_episode_steps=20)
    assert (
        env.env_is_wrapped(Monitor, [0, 2]) == [True] * 2
        and env.env_is_wrapped(TimeLimit) == [False] * 3
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rewards, lengths = evaluate_policy(_Hover(), env, 3, return_episode_rewards=True)
        EvalCallback(env, n_eval_episodes=3)
    assert lengths == [20] * 3 and rewards == pytest.approx([-0.6] * 3, abs=0.01)


class _Hover:
    def predict(self, observation, **_):
        return np.zeros((len(observation), 4)), None


def test_staggered_episodes_end_at_times_spread_evenly():
    env = QuadcopterVecEnv(20, seed=0, max_episode_steps=100, staggered=True)
    plain = QuadcopterVecEnv(20, seed=0, max_episode_steps=100)
    env.reset()
    plain.reset()
    np.testing.assert_array_equal(env.true_state().array, plain.true_state().array)
    ends = []
    for step in range(1, 301):
        infos = env.step(np.zeros((20, 4)))[3]
        ends += [(step, info["episode"]["l"]) for info in infos if info]
        if step == 50:
            kept = env.batch.snapshot()
    assert ends == [(5 * k, min(5 * k, 100)) for k in range(1, 61)]
    again = QuadcopterVecEnv(20, max_episode_steps=100)
    again.batch.restore(kept)
    lengths = [
        info["episode"]["l"] for _ in range(10) for info in again.step(np.zeros((20, 4)))[3] if info
    ]
    assert lengths == [55, 60]


def test_rows_can_have_limits_of_their_own():
    env = QuadcopterVecEnv(5, seed=0, max_episode_steps=[10, 25], staggered=True)
    assert env.batch.max_steps.tolist() == [10, 25, 10, 25, 10]
    env.reset()
    lengths = {row: [] for row in range(5)}
    for _ in range(80):
        for row, info in enumerate(env.step(np.zeros((5, 4)))[3]):
            lengths[row] += [info["episode"]["l"]] if info else []
    first = {0: 10, 1: 20, 2: 6, 3: 10, 4: 2}
    for row, each in lengths.items():
        assert each[0] == first[row]
        assert {*each[1:]} == {25 if row % 2 else 10}


def test_scaling_and_noise_of_one_row_act_on_that_row():
    plain = QuadcopterVecEnv(70, noise=0.0, seed=0)
    mean, std = plain.observation_mean, plain.observation_std
    mean[66], std[66] = 0.5, 4.0
    changed = QuadcopterVecEnv(70, noise=0.0, seed=0, observation_mean=mean, observation_std=std)
    changed.set_noise(0.2, indices=[1])
    expected, got = plain.reset(), changed.reset()
    others = [row for row in range(70) if row not in (1, 66)]
    np.testing.assert_array_equal(got[others], expected[others])
    np.testing.assert_allclose(
        got[66], (expected[66] * plain.observation_std[66] - 0.5) / 4.0, atol=1e-6
    )
    assert not np.allclose(got[1], expected[1])


# --- refusals


def test_bad_actions_are_refused_and_change_nothing():
    env = QuadcopterVecEnv(70, seed=0)
    env.reset()
    before = env.true_state().copy()
    for wrong in (np.zeros((70, 3)), np.zeros(4), np.zeros((69, 4))):
        with pytest.raises(ValueError, match="action"):
            env.step(wrong)
    for value in (np.nan, np.inf, -np.inf):
        actions = np.zeros((70, 4))
        actions[68, 2] = value
        with pytest.raises(ValueError, match="row 68"):
            env.step(actions)
    np.testing.assert_array_equal(env.true_state().array, before.array)


def test_steps_wait_for_the_first_reset():
    env, other = QuadcopterVecEnv(2, seed=0), QuadcopterVecEnv(2, seed=0)
    actions = np.zeros((2, 4), np.float32)
    for _ in range(2):
        with pytest.raises(ResetNeeded, match="reset"):
            env.step(actions)
    other.reset()
    # A restored run goes on without a reset.
    env.batch.restore(other.batch.snapshot())
    np.testing.assert_array_equal(env.step(actions)[0], other.step(actions)[0])


def test_targets_wait_for_the_first_reset():
    env = QuadcopterVecEnv(2)
    for setter in (env.set_target, env.set_reference):
        with pytest.raises(ResetNeeded, match="call reset"):
            setter((1, 2, 15))
    env.batch.reset(0)
    env.set_target((1, 2, 15), indices=0)
    with pytest.raises(ResetNeeded):
        env.set_target((1, 2, 15), indices=1)


def test_wind_without_drag_warns():
    with pytest.warns(UserWarning, match="wind"):
        QuadcopterVecEnv(1).set_wind((1, 0, 0))
    with pytest.warns(UserWarning, match="wind"):
        QuadcopterVecEnv(1, randomize={"wind": [0, 4]})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        QuadcopterVecEnv(1).set_wind()
        QuadcopterVecEnv(1, vehicle="cf2x_L250").set_wind((1, 0, 0))
        QuadcopterVecEnv(1, randomize={"drag": [0, 0.5]}).set_wind((1, 0, 0))


def test_unknown_rows_methods_and_attributes_are_refused():
    env = QuadcopterVecEnv(2)
    for indices in ([2], 1.5):
        with pytest.raises(ConfigError, match="0 to 1"):
            env.set_target((0, 0, 1), indices=indices)
    with pytest.raises(AttributeError):
        env.env_method("fly_home")
    with pytest.raises(AttributeError):
        env.set_attr("colour", 1)
    with pytest.raises(AttributeError):
        env.get_attr("colour")
    env.set_options({"target": (0, 0, 1)})
    with pytest.raises(ConfigError, match="options"):
        env.reset()
    env.reset()


# --- Stable-Baselines3
