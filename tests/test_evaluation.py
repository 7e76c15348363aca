"""Flights: what is measured is the true flight of the episodes that were asked for."""

import tracemalloc

import numpy as np
import pytest
import torch

from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.evaluation import statistics
from sb3_quad.evaluation.flights import Flights, fly
from sb3_quad.evaluation.following import FOLLOWED
from sb3_quad.evaluation.hover import HOVERED
from sb3_quad.evaluation.metric_tables import SUCCESS, metric_cells, metric_rows
from sb3_quad.evaluation.metrics import summarise
from sb3_quad.evaluation.scenarios.load import load_suite
from sb3_quad.evaluation.statistics import bootstrap, mean, share
from sb3_quad.evaluation.tables import Table
from sb3_quad.experts.pid import PIDExpert


def fall(observation):
    return -np.ones((len(observation), 4), dtype=np.float32)


def hover(observation):
    return np.zeros((len(observation), 4), dtype=np.float32)


def test_metrics_are_those_of_the_environment():
    env = QuadcopterVecEnv(6, task="state_recovery", seed=3, max_episode_steps=300)
    expert = PIDExpert()
    ended = {}
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
    assert flights.collision.all() and not flights.survival.any() and not flights.success.any()
    # At most one step's way past contact
    np.testing.assert_allclose(flights.path_length, 15 - 0.135, atol=0.15)
    assert (flights.length == flights.length[0]).all()
    assert np.isnan(flights.time_to[0.1]).all()


def test_hovering_covers_no_distance_and_time_zero_is_the_start():
    near = {"task_kwargs": {"target_distance": 0.3}, "max_episode_steps": 5}
    flights = fly(hover, "target_tracking", 2, seed=0, **near)
    assert (flights.time_to[0.5] == 0.0).all() and np.isnan(flights.time_to[0.2]).all()
    assert flights.survival.all() and not flights.success.any() and (flights.length == 5).all()
    np.testing.assert_allclose(flights.path_length, 0.0, atol=1e-9)
    np.testing.assert_allclose(flights.final_error, 0.3)


def test_a_single_tolerance_is_taken():
    flights = fly("pid", n_episodes=2, max_episode_steps=20, tolerances=0.5)
    assert [*flights.time_to] == [0.5] and flights.length.max() == 20


def table_of(metrics, name, beside):
    scenario = load_suite("thesis").scenario(name)
    published = [scenario.published[each] for each in beside]
    rows = metric_rows(scenario, [metric_cells(metrics)], published)
    return Table(["", "agent", *beside], rows)


def test_metrics_and_tables_say_how_many_arrived():
    n = 4
    flights = Flights(
        success=np.array([True, False, False, False]),
        survival=np.array([True, True, False, True]),
        collision=np.array([False, False, True, False]),
        reward=np.full(n, -8.0),
        length=np.full(n, 1500),
        flown=np.full(n, 15.0),
        time_to={0.1: np.full(n, np.nan), 1.0: np.array([4.0, 5.0, np.nan, 6.0])},
        settling_time={0.1: np.full(n, np.nan), 1.0: np.array([4.0, 6.0, np.nan, np.nan])},
        path_length=np.full(n, 10.0),
        final_error=np.array([0.1, 0.2, 9.0, 0.3]),
        final_offset=np.array([[0.1, 0, 0], [0.2, 0, 0], [np.nan] * 3, [0.3, 0, 0]]),
        recovery_time=np.array([1.0, 2.0, np.nan, 3.0]),
        cross_track_error=np.array([0.2, 0.4, 9.0, 0.6]),
        **dict.fromkeys((*FOLLOWED, *HOVERED), np.full(n, np.nan)),
        waypoint_times=np.zeros((n, 0)),
        start=np.zeros((n, 13)),
        target=np.zeros((n, 3)),
    )
    metrics = summarise(flights)
    assert (metrics.success.value, metrics.survival.value) == (0.25, 0.75)
    assert (metrics.collisions, metrics.out_of_range) == (1, 0)
    tight, wide = metrics.arrivals
    assert (wide.time.value, wide.share.value) == (5.0, 0.75)
    assert (wide.settling.time.value, wide.settling.share.value) == (5.0, 0.5)
    assert wide.overshoot_rate.value == pytest.approx(2 / 3) and tight.overshoot_rate is None
    assert (metrics.recovery_time.time.value, metrics.recovery_time.share.value) == (2.0, 0.75)
    assert metrics.cross_track_error.value == pytest.approx(0.4)
    assert metrics.final_error_95.value == pytest.approx(0.29)
    text = str(table_of(metrics, "tracking", ["expert"]))
    for part in ("25.0 (", "75.0 (", "5.00 (", ", 75 % arrive", "never", "0.290", "7.75"):
        assert part in text
    one_lost = metrics.model_copy(update={"success": share([False] + [True] * 3839)})
    assert metric_cells(one_lost)[SUCCESS].startswith("99.97 ")  # not 100


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


def test_intervals_hold_the_value_and_narrow_with_n():
    """Wilson's for 8 of 10: 49.0 to 94.3 %, as tables have it."""
    estimate = share([True] * 8 + [False] * 2)
    assert (estimate.low, estimate.high) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    values = np.random.default_rng(0).normal(3.0, 2.0, 400)
    wide = mean(values[:40])
    narrow = mean(values)
    assert wide.high - wide.low > narrow.high - narrow.low
    assert (narrow.high - narrow.low) / 2 == pytest.approx(1.96 * values.std() / 20, rel=0.1)
    assert mean(np.array([np.nan, 2.0])).n == 1 and mean(np.array([np.nan])) is None


def test_tables_stand_without_a_single_success():
    metrics = summarise(fly(fall, "state_recovery", 2, seed=0))
    text = str(table_of(metrics, "recovery", ["expert", "RL-agent", "PPO only"]))
    assert "0.0 (" in text and "88.25" in text and "nan" not in text


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


@pytest.mark.parametrize(("threads", "in_flight"), [(8, 1), (4, 1), (3, 3)])
def test_torch_flies_with_one_thread_unless_it_was_given_another_number(
    threads, in_flight, monkeypatch
):
    monkeypatch.setattr("sb3_quad.algorithms.networks.available_cpus", lambda: 8)
    torch.set_num_threads(threads)
    seen = []

    def controller(observations):
        seen.append(torch.get_num_threads())
        return np.zeros((len(observations), 4))

    fly(controller, n_episodes=1, max_episode_steps=1)
    assert (seen, torch.get_num_threads()) == ([in_flight], threads)
