"""Logs of real flights: read, flown open loop, and fitted.

Logs that our own simulator wrote give back the parameters it flew with.
"""

import numpy as np
import pandas as pd
import pytest
import real_flights

from sb3_quad import GeometricExpert, QuadcopterVecEnv, load_vehicle
from sb3_quad.cli import main
from sb3_quad.envs.simulation.state import QUATERNION
from sb3_quad.evaluation.real_flights import (
    CAPTURE_COLUMNS,
    GYRO_COLUMNS,
    PWM,
    THRUST_BY_VOLTAGE,
    THRUSTS,
    errors,
    motor_thrusts,
    open_loop,
    read_logs,
    rotated_by,
)

STEP = 0.01
VEHICLE = load_vehicle("crazyflie_nanobench")


def flown(seed, seconds=8.0):
    """Return a log of flights to targets, as a table with thrusts in N."""
    env = QuadcopterVecEnv(
        1,
        "target_tracking",
        vehicle=VEHICLE,
        noise=0.0,
        reference={"curve": "figure_eight", "speed": 2.0},
        seed=seed,
    )
    expert = GeometricExpert(VEHICLE)
    env.reset()
    rows = []
    for now in range(round(seconds / STEP)):
        state = env.true_state()
        actions = expert.actions(state)
        thrusts = VEHICLE.action_to_thrust(actions)
        parts = (state.position, state.quaternion, state.velocity, state.body_rates, thrusts)
        rows.append(np.concatenate([[now * STEP], *(part[0] for part in parts)]))
        env.step(actions)
    return pd.DataFrame(rows, columns=["t", *CAPTURE_COLUMNS, *GYRO_COLUMNS, *THRUSTS])


def turning(seconds=6.0, turn=3.0):
    """Return a log at 100 Hz of a vehicle at one place that wobbles and turns at ``turn`` rad/s."""
    time = STEP * np.arange(round(seconds / STEP))
    wobble = [0.4 * np.sin(5.0 * time), 0.3 * np.cos(3.0 * time)]
    rates = np.stack([*wobble, turn + 0.2 * np.sin(time)], axis=1)
    attitude = [np.array([[1.0, 0.0, 0.0, 0.0]])]
    for rotation in 0.5 * STEP * (rates[1:] + rates[:-1]):
        attitude.append(rotated_by(attitude[-1], rotation[None]))
    table = pd.DataFrame({"t": time, **dict.fromkeys(CAPTURE_COLUMNS, 0.0)})
    table["pz"] = 1.0
    table[CAPTURE_COLUMNS[QUATERNION]] = np.concatenate(attitude)
    table[GYRO_COLUMNS] = rates
    return table.assign(**dict.fromkeys(THRUSTS, 0.1))


def read_back(table, folder):
    table.to_csv(folder / "flight.csv", index=False)
    return read_logs(folder, STEP)[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs")
    for seed in (0, 1, 2):
        flown(seed).to_csv(path / f"flight_{seed}.csv", index=False)
    return path


@pytest.fixture
def logs(folder):
    """The logs without calibration, which is for instruments: here, there are none."""
    logs = read_logs(folder, STEP)
    for log in logs:
        table = pd.read_csv(log.path)[: len(log.flying)]
        log.motion[:] = table[CAPTURE_COLUMNS + GYRO_COLUMNS]
        log.thrusts[:] = table[THRUSTS]
    return logs


def test_our_own_log_flown_again_is_the_same_flight(logs):
    for _, predictions, end in open_loop(logs, VEHICLE):
        assert (errors(predictions[0], end) < [1e-3, 1e-2, 0.5, 0.1]).all()
        assert (errors(predictions[2], end) > errors(predictions[0], end)).all()


@pytest.mark.slow
def test_the_example_runs(folder, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["real_flights.py", str(folder)])
    real_flights.main()
    printed = capsys.readouterr().out
    assert "judged: flight_1" in printed and "drag_z: " in printed


@pytest.mark.parametrize("late", [0, 3])
@pytest.mark.parametrize("turn", [0.0, -3.0])
def test_the_clock_is_found_while_the_vehicle_turns(tmp_path, turn, late):
    table = turning(turn=turn)
    table[GYRO_COLUMNS] = table[GYRO_COLUMNS].shift(late).bfill()
    assert read_back(table, tmp_path).offset == pytest.approx(late * STEP, abs=0.002)


@pytest.mark.parametrize("missing", [2, 7])
def test_nothing_is_known_within_a_long_gap(tmp_path, missing):
    table = turning()
    log = read_back(table.drop(range(200, 200 + missing)), tmp_path)
    is_long = (missing + 1) * STEP > 0.05
    assert not log.flying[200 : 200 + missing].any() if is_long else log.flying.all()
    assert log.flying[:199].all() and log.flying[201 + missing :].all()


def test_a_quaternion_and_its_negative_are_one_attitude(tmp_path):
    table = turning()
    expected = read_back(table, tmp_path).motion
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(table), 1))
    table[CAPTURE_COLUMNS[QUATERNION]] *= signs
    cosines = (read_back(table, tmp_path).motion * expected)[:, QUATERNION].sum(axis=1)
    np.testing.assert_allclose(np.abs(cosines), 1.0, atol=1e-9)


def test_pwm_becomes_the_thrust_that_the_firmware_expects():
    pwm = np.array([[65535.0, 32767.5, 0.0, 70000.0]])
    thrusts = motor_thrusts(pwm, np.array([[3.4]]))
    expected = sum(c * 3.4**k for k, c in enumerate(THRUST_BY_VOLTAGE))
    assert thrusts[0, 0] == pytest.approx(expected) and 0.15 < expected < 0.16
    assert 0.0 < thrusts[0, 1] < thrusts[0, 0] and np.isnan(thrusts[0, 2:]).all()


def test_check_vehicle_prints_the_errors(folder, capsys):
    assert main(["check-vehicle", "crazyflie_nanobench", "--flights", str(folder)]) == 0
    assert "after 0.2 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda table: table.drop(columns=["qw"]), "qw"),
        (lambda table: table.assign(qw="a"), "bad.csv"),
        (lambda table: table[:1], "bad.csv"),
        (lambda table: table.assign(vx=table["vx"].where(table.index != 8)), "row 9: vx"),
        (lambda table: table.assign(t=table["t"].where(table.index != 8, 0.01)), "row 9: t"),
        (lambda table: table.assign(pz=0.0), "0.3 m"),
        (lambda table: table.drop(columns=THRUSTS), PWM[0]),
        # In other units, axes or orders, or damaged
        (lambda table: table.assign(t=1e6 * table["t"]), "is t in s"),
        (lambda table: table.assign(t=table["t"].where(table.index < 199, 1e300)), "is t in s"),
        (lambda table: table[:50], "shorter than 1 s"),
        (lambda table: table.assign(imu_gyro_x=57.3 * table["imu_gyro_x"]), "imu_gyro_x"),
        (lambda table: table.assign(imu_gyro_z=-table["imu_gyro_z"]), "imu_gyro_z"),
        (lambda table: table.assign(px=1000.0 * np.sin(table["t"])), "vx"),
        (lambda table: table.assign(vy=1e300), "vy"),
        (lambda table: table.assign(qw=table["qw"].where(table.index != 8, 9.0)), "row 9: qw"),
        (lambda table: table.assign(thrust_m2=-0.1), "M2"),
        (lambda table: table.assign(thrust_m2=1e300), "thrust_m2"),
        (lambda table: table.rename(columns={"vz": "vx"}), "twice"),
    ],
)
def test_a_log_that_does_not_fit_is_refused_in_a_line(tmp_path, capsys, change, named):
    change(turning(2.0)).to_csv(tmp_path / "bad.csv", index=False)
    assert main(["check-vehicle", "crazyflie", "--flights", str(tmp_path), "-n", "0"]) == 2
    error = capsys.readouterr().err
    assert named in error and error.count("\n") == 1


def test_a_vehicle_in_other_axes_is_refused(folder, capsys):
    assert main(["check-vehicle", "hummingbird", "--flights", str(folder), "-n", "0"]) == 2
    assert "hummingbird" in capsys.readouterr().err
