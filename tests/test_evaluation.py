"""Flights: what is measured is the true flight of the episodes that were asked for, in either
environment.
"""

import io
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from sb3_quad import env_kwargs, load_pretrained
from sb3_quad.base.errors import ConfigError, ControllerError
from sb3_quad.base.seeds import row_seeds
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation import statistics
from sb3_quad.evaluation.flights import TOLERANCES, Flights, Hook, fly, fly_settings
from sb3_quad.evaluation.following import FOLLOWED
from sb3_quad.evaluation.metric_tables import SUCCESS, metric_cells, metric_rows
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.statistics import bootstrap, share
from sb3_quad.evaluation.tables import Column, Table
from sb3_quad.experts.pid import PIDExpert

BACKENDS = ("batch", "pybullet")


def fall(observation):
    return -np.ones((len(observation), 4), dtype=np.float32)


def hover(observation):
    return np.zeros((len(observation), 4), dtype=np.float32)


def same(a: Flights, b: Flights, tolerances=TOLERANCES) -> None:
    assert (a.success == b.success).all() and (a.survival == b.survival).all()
    assert (a.length == b.length).all()
    for name in ("reward", "path_length", "final_error"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-6, atol=1e-6)
    for tolerance in tolerances:
        np.testing.assert_allclose(a.time_to[tolerance], b.time_to[tolerance], atol=1e-9)


@pytest.mark.parametrize("vehicle", ["crazyflie", "hummingbird", "itm"])
@pytest.mark.parametrize("task", ["target_tracking", "state_recovery"])
def test_pybullet_gives_the_same_flights(task, vehicle):
    expert = PIDExpert(vehicle)
    flights = [
        fly(expert, task, 3, seed=11, vehicle=vehicle, backend=backend, max_episode_steps=400)
        for backend in BACKENDS
    ]
    same(*flights)


def test_pybullet_flies_what_each_row_has():
    rows = {"vehicle": ["crazyflie", "itm"], "noise": [0.1, 0.0]}
    rows["observation_std"] = np.outer([1.0, 2.0], np.ones(18))
    expert = load_pretrained("itm-recovery")
    same(
        *(
            fly(expert, "state_recovery", 2, backend=b, max_episode_steps=60, **rows)
            for b in BACKENDS
        )
    )


@settings(max_examples=settings().max_examples // 20)
@given(seed=st.integers(0, 2**20), n=st.integers(1, 5))
def test_rows_do_not_depend_on_their_number(seed, n):
    recovery = FlightSettings(task="state_recovery", max_episode_steps=150)
    alone = fly_settings(PIDExpert(), recovery, row_seeds(seed, n)[-1:])
    among = fly(PIDExpert(), "state_recovery", n, seed, max_episode_steps=150)
    last = {
        name: {key: times[-1:] for key, times in values.items()}
        if isinstance(values, dict)
        else values[-1:]
        for name, values in vars(among).items()
    }
    same(alone, Flights(**last))


def test_metrics_are_those_of_the_environment():
    env = QuadcopterVecEnv(6, task="state_recovery", seed=3, max_episode_steps=300)
    expert, ended = PIDExpert(), {}
    env.reset()
    while len(ended) < 6:
        _, _, dones, infos = env.step(expert.actions(env.true_state()))
        for row in np.flatnonzero(dones):
            ended.setdefault(int(row), infos[row])
    flights = fly(expert, "state_recovery", 6, seed=3, max_episode_steps=300)
    for row, info in ended.items():
        assert (flights.success[row], flights.survival[row]) == (
            info["is_success"],
            info["survival"],
        )
        assert flights.length[row] == info["episode"]["l"]
        assert flights.reward[row] == pytest.approx(info["episode"]["r"], abs=1e-4)
        assert flights.final_error[row] == pytest.approx(info["distance"], abs=1e-9)


def test_a_fall_is_as_long_as_it_is_high():
    flights = fly(fall, "target_tracking", 4, seed=0)
    assert not flights.survival.any() and not flights.success.any()
    assert flights.path_length == pytest.approx(
        np.full(4, 15 - 0.135), abs=0.15
    )  # at most one step's way past contact
    assert (flights.length == flights.length[0]).all()
    assert np.isnan(flights.time_to[0.1]).all()


def test_hovering_covers_no_distance_and_time_zero_is_the_start():
    flights = fly(
        hover,
        "target_tracking",
        2,
        seed=0,
        max_episode_steps=5,
        task_kwargs={"target_distance": 0.3},
    )
    assert (flights.time_to[0.5] == 0.0).all()
    assert np.isnan(flights.time_to[0.2]).all()
    assert flights.survival.all() and not flights.success.any() and (flights.length == 5).all()
    assert flights.path_length == pytest.approx(np.zeros(2), abs=1e-9)
    assert flights.final_error == pytest.approx(np.full(2, 0.3))


def test_an_own_reward_is_summed_over_the_control_steps_of_each_flight():
    class Tilts(Hook):
        """The z axis after each step, which a flight's last step has, too."""

        def on_start(self, state, vehicle):
            self.seen = []

        def after_step(self, step, state, actions, flying):
            self.seen.append(np.square(actions).sum(axis=1) + state.position[:, 2])

    hook = Tilts()
    flights = fly(
        fall,
        "state_recovery",
        4,
        hooks=[hook],
        reward=lambda state, actions: np.square(actions).sum(axis=1) + state.position[:, 2],
    )
    assert not flights.survival.any() and len(set(flights.length)) > 1
    for row, length in enumerate(flights.length):
        expected = sum(values[row] for values in hook.seen[:length])
        assert flights.own_reward[row] == pytest.approx(expected, rel=1e-12)
    assert np.isnan(fly(fall, "state_recovery", 4).own_reward).all()
    # Nobody asks about a flight that was lost before, and is below ground or far away now.
    lost = fly(fall, "state_recovery", 4, reward=Height(flights.length))
    assert np.isfinite(lost.own_reward).all()
    assert (
        fly(fall, n_episodes=2, max_episode_steps=3, reward=Changes).own_reward == [1.0, 1.0]
    ).all()


class Height:
    """A reward that is none where the flight is over, by its length."""

    def __init__(self, length):
        self.left = length.copy()

    def __call__(self, state, actions):
        self.left -= 1
        return np.where(self.left >= 0, 1.0, np.nan)


class Changes:
    """A reward that remembers: by how much the first action changes, from hover."""

    last = 0.0

    def __call__(self, state, actions):
        change = abs(actions[:, 0] - self.last)
        self.last = actions[:, 0]
        return change


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        (lambda state, actions: 1.0, r"gives shape \(\), must be \(3,\)"),
        (lambda state, actions: state.nothing, r"fails \(AttributeError"),
        (lambda state, actions: np.full(3, np.inf), "gives inf in row 0"),
    ],
)
def test_an_own_reward_that_does_not_fit_is_named(reward, message):
    with pytest.raises(ControllerError, match=f"reward <lambda>: {message}"):
        fly(hover, n_episodes=3, max_episode_steps=2, reward=reward)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"n_episodes": 4.0}, "n_episodes 4.0: must be a whole number from 1 to"),
        ({"n_episodes": 0}, "n_episodes 0"),
        ({"n_episodes": 4}, r"fly: unknown keyword 'n_episodes' \(valid: .*n_episodes"),
        ({"seed": -1}, "seed -1: must be a whole number from 0 to"),
        ({"seed": 0.5}, "seed 0.5"),
        ({"tolerances": "near"}, "tolerances 'near': must be numbers"),
        ({"tolerances": -1.0}, r"tolerances \[-1.0\]: must be greater than 0 m"),
        ({"tolerances": [0.1, 0.0]}, "must be greater than 0 m"),
        ({"max_episode_steps": [100, 300]}, r"max_episode_steps \[100, 300\]: must be one number"),
    ],
)
def test_numbers_that_do_not_fit_are_named(keywords, message):
    with pytest.raises(ConfigError, match=message):
        fly("pid", **keywords)


def test_a_single_tolerance_and_the_name_of_the_environments_are_taken():
    flights = fly("pid", n_episodes=2, max_episode_steps=20, tolerances=0.5)
    same(flights, fly("pid", n_episodes=2, max_episode_steps=20, tolerances=[0.5]), [0.5])
    assert [*flights.time_to] == [0.5] and flights.length.max() == 20


def test_the_conventions_give_the_specified_metrics():
    metrics = summarise(fly(PIDExpert(), "target_tracking", 480, seed=0))
    arrivals = {arrival.tolerance: arrival for arrival in metrics.arrivals}
    for tolerance, seconds in {0.1: 7.71, 0.2: 6.89, 0.5: 5.80, 1.0: 4.90}.items():
        assert arrivals[tolerance].time.value == pytest.approx(seconds, rel=0.02)
        assert arrivals[tolerance].share.value == 1.0
    assert metrics.path.value == pytest.approx(10.42, rel=0.02)
    assert metrics.reward.value == pytest.approx(-8.10, rel=0.02)
    assert metrics.success.value == 1.0


def text_of(table) -> str:
    console = Console(file=io.StringIO(), width=200)
    console.print(table)
    return console.file.getvalue()


def test_times_to_stay_and_overshoot_are_those_of_the_distances():
    class Distances(Hook):
        def on_start(self, state, vehicle):
            self.seen = [state.distance.copy()]

        def after_step(self, step, state, actions, flying):
            self.seen.append(state.distance.copy())

    distances = Distances()
    flights = fly(
        load_pretrained("itm-robust"),
        n_episodes=24,
        max_episode_steps=700,
        hooks=[distances],
        **env_kwargs("itm-robust"),
    )
    leaves = []
    for row, seen in enumerate(np.array(distances.seen).T):
        within = seen <= 0.1
        first, last = int(np.argmax(within)), len(seen) - int(np.argmin(within[::-1]))
        assert flights.time_to[0.1][row] == pytest.approx(first * 0.01)
        assert flights.settling_time[0.1][row] == pytest.approx(last * 0.01)
        assert flights.overshoot[row] == pytest.approx(seen[first:].max())
        leaves.append(first != last)
    assert 0 < sum(leaves) < 24 or all(flights.overshoot <= 0.1)
    assert summarise(flights).arrivals[0].overshoot_rate.value == np.mean(leaves)


@pytest.mark.parametrize("suite", ["thesis", "robustness", "trajectories"])
def test_an_own_reward_stands_in_the_table_of_every_scenario(suite):
    flights = fly(
        hover, n_episodes=2, max_episode_steps=2, reward=lambda state, actions: state.distance
    )
    cells = metric_cells(summarise(flights))
    for scenario in load_suite(suite).scenarios:
        assert "mean own reward" in [row.name for row in metric_rows(scenario, [cells])]


def table_of(metrics, name, beside):
    scenario = load_suite("thesis").scenario(name)
    rows = metric_rows(
        scenario, [metric_cells(metrics)], [scenario.published[each] for each in beside]
    )
    return Table([Column("agent"), *(Column(each, source="thesis") for each in beside)], rows)


def test_tables_say_how_many_arrived():
    n = 4
    flights = Flights(
        success=np.array([True, False, False, False]),
        survival=np.array([True, True, False, True]),
        collision=np.array([False, False, True, False]),
        reward=np.full(n, -8.0),
        own_reward=np.full(n, np.nan),
        length=np.full(n, 1500),
        flown=np.full(n, 15.0),
        time_to={0.1: np.full(n, np.nan), 1.0: np.array([4.0, 5.0, np.nan, 6.0])},
        settling_time={0.1: np.full(n, np.nan), 1.0: np.array([4.0, 6.0, np.nan, np.nan])},
        overshoot=np.full(n, np.nan),
        path_length=np.full(n, 10.0),
        final_error=np.array([0.1, 0.2, 9.0, 0.3]),
        final_offset=np.array([[0.1, 0, 0], [0.2, 0, 0], [np.nan] * 3, [0.3, 0, 0]]),
        recovery_time=np.array([1.0, 2.0, np.nan, 3.0]),
        cross_track_error=np.array([0.2, 0.4, 9.0, 0.6]),
        **dict.fromkeys(FOLLOWED, np.full(n, np.nan)),
        cut_by_supervisor=np.zeros(n, bool),
        low_force_time=np.full(n, np.nan),
        waypoint_times=np.zeros((n, 0)),
        start=np.zeros((n, 13)),
        target=np.zeros((n, 3)),
    )
    metrics = summarise(flights)
    assert (metrics.success.value, metrics.survival.value) == (0.25, 0.75)
    assert (metrics.collisions, metrics.out_of_range) == (1, 0)
    assert metrics.arrivals[-1].time.value == 5.0 and metrics.arrivals[-1].share.value == 0.75
    assert (
        metrics.arrivals[-1].settling.time.value == 5.0
        and metrics.arrivals[-1].settling.share.value == 0.5
    )
    assert (
        metrics.arrivals[-1].overshoot_rate.value == pytest.approx(2 / 3)
        and metrics.arrivals[0].overshoot_rate is None
    )
    assert metrics.recovery_time.time.value == 2.0 and metrics.recovery_time.share.value == 0.75
    assert metrics.cross_track_error.value == pytest.approx(0.4)
    assert (
        metrics.final_error_95.value == pytest.approx(0.29) and metrics.final_error_95.high <= 0.3
    )
    text = text_of(table_of(metrics, "tracking", ["expert"]))
    for part in (
        "success, %",
        "25.0 (",
        "survival, %",
        "75.0 (",
        "5.00 (",
        ", 75 % arrive",
        "never",
        "0.290",
        "thesis: expert",
        "7.75",
    ):
        assert part in text
    one_lost = metrics.model_copy(update={"success": share([False] + [True] * 3839)})
    assert metric_cells(one_lost)[SUCCESS].number == "99.97"  # not 100


def test_a_bootstrap_of_many_values_needs_little_memory_and_blocks_change_no_number(monkeypatch):
    values = np.random.default_rng(1).normal(size=50_000)
    tracemalloc.start()
    whole = bootstrap(values[:999])
    bootstrap(values)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6  # at once, the indices alone would take 400 MB
    monkeypatch.setattr(statistics, "BLOCK", 2500)
    assert bootstrap(values[:999]) == whole
    monkeypatch.setattr(statistics, "BLOCK", 1)
    assert bootstrap(values[:999]) == whole


def test_tables_stand_without_a_single_success():
    metrics = summarise(fly(fall, "state_recovery", 2, seed=0))
    text = text_of(table_of(metrics, "recovery", ["expert", "RL-agent", "PPO only"]))
    assert "0.0 (" in text and "88.25, 88.75 % while training" in text
    assert "nan" not in text


def test_a_recorded_flight_holds_what_was_seen_and_done(tmp_path):
    seen = []

    def pilot(observation):
        seen.append(observation.copy())
        return np.full((len(observation), 4), -1.5)  # beyond the range, which is clipped

    flights = fly(pilot, n_episodes=3, max_episode_steps=400, record=tmp_path / "f.npz")
    with np.load(tmp_path / "f.npz") as file:
        observations, actions = file["observations"], file["actions"]
    assert len(observations) == len(actions) == flights.length.sum() < 3 * 400
    np.testing.assert_array_equal(observations[:6], np.concatenate(seen[:2]))
    assert (actions == -1.0).all()
