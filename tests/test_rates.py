"""Actions that command thrust and body rates: the rate loop, its experts, and what is refused."""

import numpy as np
import pytest
from sampled_vehicles import sample_vehicles

from sb3_quad.agents.agent_settings import settings_of_model
from sb3_quad.agents.zips import load_model
from sb3_quad.algorithms.apg import APG
from sb3_quad.algorithms.dagger import DAgger
from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.envs import QuadcopterEnv, QuadcopterVecEnv
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import BODY_RATES, ROTOR_SPEEDS, P
from sb3_quad.envs.vehicles.rates import RATE_PARAMETERS
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.compare import compare
from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.geometric import GeometricExpert
from sb3_quad.experts.pid import PIDExpert
from sb3_quad.export.policy import export_policy

LOOPS = {"rate_gains": [0.5, 2.0], "rate_lag": [0.0, 0.02]}
TORQUE = {"magnitude": 0.05, "unit": "weight", "axes": [1.0, 1.0, 0.3]}


def new_batch(n, seed=0, **keywords):
    keywords = {"task": "state_recovery", "action": "rates", "noise": 0.0, **keywords}
    batch = QuadcopterBatch(n, FlightSettings(**keywords), seed, 1)
    batch.reset()
    return batch


def changed(**keywords):
    return load_vehicle("itm").model_copy(update=keywords)


def slow_actions(steps, n, seed):
    """Held for a tenth of a second, some beyond their limits."""
    held = np.random.default_rng(seed).uniform(-1.5, 1.5, (steps // 10 + 1, n, 4))
    return held.repeat(10, axis=0)[:steps].astype(np.float32)


def test_a_start_that_is_given_begins_the_filter():
    env = QuadcopterEnv("state_recovery", action="rates")
    env.reset(options={"state": {"body_rates": [1.0, -2.0, 3.0]}})
    np.testing.assert_array_equal(env.batch.filtered_rates[:, 0], [1.0, -2.0, 3.0])


def wanted(batch, action, rates):
    """What one physics step's rotor speeds would give if motors were fast: thrust and moments, and
    the thrust of each rotor, N.
    """
    batch.queue[:] = 0.0
    batch.state[BODY_RATES] = batch.filtered_rates[:] = rates
    batch.step_on(action, 1)
    vehicle = batch.vehicle_list[0]
    thrusts = vehicle.lift * batch.state[ROTOR_SPEEDS] ** 2
    return vehicle.mixer @ thrusts, thrusts


def test_roll_and_pitch_come_before_thrust_and_thrust_before_yaw():
    # Motors that reach any speed within the physics step show what the loop commands.
    fast = {"motor_gain": 100.0, "delay": 0, "rotor_thrust_limits": [0.0, 7.0]}
    vehicle = changed(**fast, rates={"limits": [9, 8, 3], "gains": [20, 25, 9], "lag": 0})
    rng = np.random.default_rng(0)
    n = 600
    action = rng.uniform(-1.0, 1.0, (n, 4)).astype(np.float32)
    rates = rng.choice([0.1, 1.0, 5.0], n) * rng.standard_normal((3, n))
    found, thrusts = wanted(new_batch(n, vehicle=vehicle), action, rates)

    inertia = np.array(vehicle.inertia)[:, None]
    action = action.astype(float)
    error = np.array([[9.0], [8.0], [3.0]]) * action.T[1:] - rates
    torque = inertia * np.array([[20.0], [25.0], [9.0]]) * error
    torque += np.cross(rates.T, (inertia * rates).T).T
    thrust = 14.0 * (1.0 + action[:, 0])
    tilting = vehicle.mixer_inverse[:, 1:3] @ torque[:2]
    least, most = 0.007, 7.0
    assert (thrusts > least - 1e-9).all() and (thrusts < most + 1e-9).all()
    # Roll and pitch, as far as there is room for any
    scale = np.minimum(1.0, (most - least) / np.ptp(tilting, axis=0))
    np.testing.assert_allclose(found[1:3], scale * torque[:2], atol=1e-9)
    # The thrust moves only as far as they need it.
    room = 4 * (least - scale * tilting.min(axis=0)), 4 * (most - scale * tilting.max(axis=0))
    np.testing.assert_allclose(found[0], thrust.clip(*room), rtol=1e-9)
    # Yaw is as wanted, or less, and then some rotor is at its limit.
    share = found[3] / torque[2]
    assert (share > -1e-9).all() and (share < 1.0 + 1e-9).all()
    at_limit = np.minimum(thrusts - least, most - thrusts).min(axis=0) < 1e-9
    assert at_limit[share < 1.0 - 1e-6].all()
    # Each of these happens.
    assert (scale < 1.0).any() and (share < 0.5).any() and (share > 1.0 - 1e-9).any()


def test_a_vehicle_in_flight_has_the_body_rates_that_are_commanded():
    batch = new_batch(3, task="target_tracking", vehicle="crazyflie")
    limits, _ = batch.vehicle_list[0].rate_limits_and_gains
    action = np.zeros((3, 4), np.float32)
    action[:, 0] = batch.vehicle_list[0].hover_action.mean()
    action[[0, 1, 2], [1, 2, 3]] = 0.1
    for _ in range(60):
        batch.step(action)
    assert np.diag(batch.state[BODY_RATES]) == pytest.approx(0.1 * np.array(limits), rel=0.05)


def test_thrusts_do_not_feel_the_rate_loop():
    flown = []
    for rates in ("px4", {"limits": [1, 1, 1], "gains": [3, 3, 3]}):
        batch = new_batch(8, action="thrusts", vehicle=changed(rates=rates), randomize=LOOPS)
        for action in slow_actions(30, 8, 0):
            batch.step(action)
        flown.append(batch.state.copy())
    np.testing.assert_array_equal(*flown)


def test_a_loop_is_random_by_numbers_of_its_own():
    rest = {"mass": [0.8, 1.2], "delay": [0, 3], "thrust": [0.9, 1.0]}
    plain = new_batch(400, randomize=rest).vehicles
    batch = new_batch(400, randomize={**rest, **LOOPS})
    rates = slice(P.rate_limit_x, P.rate_limit_x + len(RATE_PARAMETERS))
    others = np.ones(len(plain), bool)
    others[rates] = False
    np.testing.assert_array_equal(batch.vehicles[others], plain[others])
    gains = batch.vehicles[P.rate_gain_x : P.rate_lag] / plain[P.rate_gain_x : P.rate_lag]
    np.testing.assert_allclose(gains[0], gains[1])
    assert 0.5 <= gains.min() < 0.52 and 1.95 < gains.max() <= 2.0
    lags = batch.vehicles[P.rate_lag] - plain[P.rate_lag]
    assert 0.0 <= lags.min() < 0.001 and 0.019 < lags.max() <= 0.02


def test_sampled_vehicles_have_the_loops_that_their_files_would_have():
    batch = new_batch(40, vehicles={"distribution": "raptor"})
    vehicles = sample_vehicles("raptor", 40)
    theirs = np.stack([vehicle.parameters() for vehicle in vehicles], axis=1)
    at = slice(P.rate_limit_x, P.rate_limit_x + len(RATE_PARAMETERS))
    np.testing.assert_allclose(batch.vehicles[at], theirs[at], rtol=1e-9)
    # Quick motors with little torque are not left with a few rad/s.
    turning = batch.vehicles[P.rate_limit_x : P.rate_limit_x + 2]
    assert turning.min() == 10.0 and turning.max() == 20.0
    assert batch.vehicles[P.rate_limit_x + 2].min() < 10.0


def test_a_vehicle_that_is_turned_keeps_the_loop_of_each_axis():
    limits, gains = [5.0, 5.0, 2.0], [9.0, 9.0, 3.0]
    turned = changed(inertia=[0.01, 0.01, 0.01], rates={"limits": limits, "gains": gains})
    turned = turned.in_layout_of(load_vehicle("hummingbird"))
    np.testing.assert_allclose(turned.rate_limits_and_gains, [limits, gains])


@pytest.mark.parametrize(
    ("expert", "task", "vehicle"),
    [
        ("pid", "target_tracking", "itm"),
        ("geometric", "state_recovery", "crazyflie"),
        ("privileged_geometric", "target_tracking", "itm"),
    ],
)
def test_experts_fly_with_body_rates(expert, task, vehicle):
    keywords = {} if expert == "pid" else {"randomize": LOOPS}
    if expert.startswith("privileged"):
        # Without knowing it, the rates would be wrong all the time.
        keywords["randomize"] = {**LOOPS, "torque": TORQUE}
    flights = fly(expert, task, 20, 0, vehicle=vehicle, action="rates", **keywords)
    assert flights.survival.all() and np.median(flights.final_error) < 0.1


def test_a_zip_says_what_its_actions_command(tmp_path):
    env = QuadcopterVecEnv(8, "state_recovery", action="rates", randomize=LOOPS, seed=0)
    small = {"policy_kwargs": {"net_arch": [8]}, "seed": 0, "device": "cpu"}
    model = DAgger("MlpPolicy", env, expert="geometric", n_steps=8, batch_size=32, **small)
    model.learn(64)
    model.save(tmp_path / "rates")
    own = settings_of_model(load_model(tmp_path / "rates.zip"))
    assert own.observed["action"] == "rates"
    APG("MlpPolicy", env, initial_policy=model, n_steps=8, **small).learn(64)
    # It flies as it was trained, and files of it command the same.
    fly(str(tmp_path / "rates.zip"), "state_recovery", 2, max_episode_steps=20)
    shown = {"agent": model, "named": "geometric", "own": GeometricExpert(action="rates")}
    assert compare(shown, "state_recovery", n_episodes=2, max_episode_steps=20)["named"]
    for file_format in ("c", "onnx"):
        exported = export_policy(tmp_path / "rates.zip", file_format, n_observations=100)
        assert "collective thrust" in exported.metadata["result"]
    for unfit in ({"file_format": "crazyflie"}, {"file_format": "c", "output": "speeds"}):
        with pytest.raises(ConfigError, match="rates"):
            export_policy(tmp_path / "rates.zip", **unfit)


@pytest.mark.parametrize("action", ["thrusts", "rates"])
def test_a_policy_or_an_expert_of_the_other_kind_is_refused(action, tmp_path, capsys):
    other = {"thrusts": "rates", "rates": "thrusts"}[action]
    env = QuadcopterVecEnv(4, action=action)
    theirs = QuadcopterVecEnv(4, action=other)
    model = APG("MlpPolicy", theirs, policy_kwargs={"net_arch": [8]}, device="cpu")
    model.save(tmp_path / "other")
    refused = f"commands {other}, and here actions are {action}"
    for expert in (model, GeometricExpert(action=other), PIDExpert(action=other)):
        with pytest.raises(ConfigError, match=refused):
            DAgger("MlpPolicy", env, expert=expert, device="cpu").learn(8)
        with pytest.raises(ConfigError, match=refused):
            fly(expert, n_episodes=1, action=action)
    with pytest.raises(ConfigError, match=refused):
        APG("MlpPolicy", env, initial_policy=str(tmp_path / "other.zip"), device="cpu")
    command = f"train --algo apg -n 8 -i {tmp_path / 'other.zip'} -f {tmp_path} --env-kwargs"
    assert main([*command.split(), f"action:{action}"]) == 2
    assert refused in capsys.readouterr().err
