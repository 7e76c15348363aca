"""Logs of real flights: read, flown open loop, and fitted.

Logs that our own simulator wrote give back the parameters it flew with. Real ones are looked for in
the folder that SB3_QUAD_FLIGHTS names.
"""

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from real_flights import Cascade, Run, estimates, fit, lagged, started

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.envs.simulation.state import QUATERNION
from sb3_quad.envs.vehicles.vehicle import load_vehicle
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

FOLDER = os.environ.get("SB3_QUAD_FLIGHTS", "")
STEP = 0.01
real = pytest.mark.skipif(not Path(FOLDER or "-").is_dir(), reason="SB3_QUAD_FLIGHTS: no folder")
VEHICLE = load_vehicle("crazyflie_nanobench")


def flown(vehicle, seconds=12.0, seed=0):
    """Return a log of the cascade along a curve, as a table with thrusts in N."""
    rng = np.random.default_rng(seed)
    batch = started(vehicle, 1, [0.0, 0.0, 1.0])
    controller = Cascade(vehicle, 1)
    phase = rng.uniform(0.0, 6.28, 3)
    rows = []
    for now in range(round(seconds / STEP)):
        state = batch.true_state()
        curve = np.sin([1.1, 0.9, 0.5] * np.full(3, 2.0 * now * STEP) + phase)
        target = curve * [0.8, 0.8, 0.3] + [0.0, 0.0, 1.0]
        thrusts = controller.thrusts(state, target[None], state.body_rates)
        thrusts = np.clip(thrusts, *vehicle.thrust_range)
        parts = (state.position, state.quaternion, state.velocity, state.body_rates, thrusts)
        rows.append(np.concatenate([[now * STEP], *(part[0] for part in parts)]))
        batch.step(vehicle.thrust_to_action(thrusts))
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


def read_back(table, folder, step=STEP):
    table.to_csv(folder / "flight.csv", index=False)
    return read_logs(folder, step)[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs")
    for seed in (0, 1, 2):
        flown(VEHICLE, seed=seed).to_csv(path / f"flight_{seed}.csv", index=False)
    return path


def raw(logs, folder):
    """Return the logs without calibration, which is for instruments: here, there are none."""
    for log in logs:
        table = pd.read_csv(log.path)[: len(log.flying)]
        log.motion[:] = table[CAPTURE_COLUMNS + GYRO_COLUMNS]
        log.thrusts[:] = table[THRUSTS]
    return logs


def test_our_own_log_flown_again_is_the_same_flight(folder):
    logs = raw(read_logs(folder, STEP), folder)
    for _, predictions, end in open_loop(logs, VEHICLE):
        assert (errors(predictions[0], end) < [1e-4, 1e-3, 0.05, 0.01]).all()
        assert (errors(predictions[2], end) > errors(predictions[0], end)).all()


def test_calibration_leaves_a_log_without_faults_nearly_alone(folder):
    for log in read_logs(folder, STEP):
        assert abs(log.offset) <= 0.002 and log.flying.all()
        table = pd.read_csv(log.path)[: len(log.flying)]
        # The commands leap in the first rows.
        np.testing.assert_allclose(log.thrusts[5:], table[THRUSTS][5:], rtol=0.01)
        gap = log.motion[:, QUATERNION] - table[CAPTURE_COLUMNS[QUATERNION]]
        # Half the angle
        assert np.linalg.norm(gap, axis=1).max() < np.radians(1.0)


def test_a_late_clock_tilted_markers_and_an_uneven_motor_are_calibrated(folder, tmp_path):
    table = pd.read_csv(folder / "flight_0.csv")
    late = table.copy()
    late[[*GYRO_COLUMNS, *THRUSTS]] = table[[*GYRO_COLUMNS, *THRUSTS]].shift(3).bfill()
    late[THRUSTS[0]] *= 1.1
    tilt = np.tile([[0.03, -0.02, 0.0]], (len(table), 1))
    late[CAPTURE_COLUMNS[QUATERNION]] = rotated_by(
        table[CAPTURE_COLUMNS[QUATERNION]].to_numpy(), tilt
    )
    late.to_csv(tmp_path / "late.csv", index=False)
    (log,) = read_logs(tmp_path, STEP)
    (true,) = [each for each in read_logs(folder, STEP) if each.path.stem == "flight_0"]
    assert log.offset == pytest.approx(true.offset + 0.03, abs=0.002)
    inside = slice(50, -50)
    gap = (log.motion - true.motion)[inside, QUATERNION]
    assert np.abs(gap).mean() < 2e-3
    assert np.abs(log.thrusts - true.thrusts)[inside].mean() < 4e-3


@pytest.mark.parametrize("late", [0, 3])
@pytest.mark.parametrize("turn", [0.0, 1.5, 3.0, -3.0])
def test_the_clock_is_found_while_the_vehicle_turns(tmp_path, turn, late):
    table = turning(turn=turn)
    table[GYRO_COLUMNS] = table[GYRO_COLUMNS].shift(late).bfill()
    assert read_back(table, tmp_path).offset == pytest.approx(late * STEP, abs=0.002)


@pytest.mark.parametrize("missing", [2, 3, 5, 7, 12])
def test_nothing_is_known_within_a_long_gap(tmp_path, missing):
    table = turning()
    log = read_back(table.drop(range(200, 200 + missing)), tmp_path)
    is_long = (missing + 1) * STEP > 0.05
    assert not log.flying[200 : 200 + missing].any() if is_long else log.flying.all()
    assert log.flying[:199].all() and log.flying[201 + missing :].all()


def test_a_quaternion_and_its_negative_are_one_attitude(tmp_path):
    table = turning()
    expected = read_back(table, tmp_path, 1.0 / 130.0).motion
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(table), 1))
    table[CAPTURE_COLUMNS[QUATERNION]] *= signs
    motion = read_back(table, tmp_path, 1.0 / 130.0).motion
    cosines = (motion * expected)[:, QUATERNION].sum(axis=1)
    np.testing.assert_allclose(np.abs(cosines), 1.0, atol=1e-9)


def test_the_fit_finds_the_parameters_that_were_flown(folder):
    logs = raw(read_logs(folder, STEP), folder)
    wrong = VEHICLE.model_copy(
        update={
            "mass": VEHICLE.mass * 1.1,
            "drag": tuple(0.6 * each for each in VEHICLE.drag),
            "inertia": tuple(1.3 * each for each in VEHICLE.inertia),
            "motor_gain": 22.0,
            "rotor_thrust_limits": VEHICLE.thrust_range,
        }
    )
    names = ("mass", "drag", "inertia", "motor_gain")
    found, _ = fit(logs, wrong, names, iterations=6)
    assert found.mass == pytest.approx(VEHICLE.mass, rel=0.01)
    assert found.drag[0] == pytest.approx(VEHICLE.drag[0], rel=0.03)
    assert found.inertia[0] == pytest.approx(VEHICLE.inertia[0], rel=0.03)
    assert found.motor_gain_up == pytest.approx(VEHICLE.motor_gain_up, rel=0.1)


@pytest.mark.parametrize(("time_constant", "delay"), [(0.03, 0.0), (0.06, 0.02)])
def test_without_feedback_all_estimates_of_the_lag_agree(time_constant, delay):
    rng = np.random.default_rng(0)
    command = np.convolve(rng.standard_normal(6000), np.ones(5) / 5.0, "same")
    late = lagged(command[:, None], time_constant, delay)
    response = np.cumsum(800.0 * late[:, 0]) * STEP
    run = Run(np.tile(command[:, None], 4), np.tile(response[:, None], 4))
    _, _, lag, _, slope = estimates([run], 0)
    assert lag == pytest.approx(1000.0 * (time_constant + delay), abs=12.0)
    assert slope == pytest.approx(800.0, rel=0.1)


def test_pwm_becomes_the_thrust_that_the_firmware_expects():
    pwm = np.array([[65535.0, 32767.5, 0.0, 70000.0]])
    thrusts = motor_thrusts(pwm, np.array([[3.4]]))
    expected = sum(c * 3.4**k for k, c in enumerate(THRUST_BY_VOLTAGE))
    assert thrusts[0, 0] == pytest.approx(expected) and 0.15 < expected < 0.16
    assert 0.0 < thrusts[0, 1] < thrusts[0, 0] and np.isnan(thrusts[0, 2:]).all()


def test_check_vehicle_prints_the_errors(folder, capsys):
    assert main(["check-vehicle", "crazyflie_nanobench", "--flights", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "position, m, after 0.2 s" in printed and "windows of 3 logs" in printed


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda table: table.drop(columns=["qw"]), "lacks qw; a log is a CSV file with"),
        (lambda table: table.assign(qw="a"), "not a table of numbers"),
        (lambda table: table[:1], "fewer than two rows"),
        (
            lambda table: table.assign(imu_gyro_y=table["imu_gyro_y"].where(table.index != 8)),
            "bad.csv: row 9: imu_gyro_y is missing, or is not a finite number",
        ),
        (
            lambda table: table.assign(t=table["t"].where(table.index != 8, 0.01)),
            "bad.csv: row 9: t is 0.01 after ",
        ),
        (lambda table: table.assign(pz=0.0), "no log flies above 0.3 m for 1 s"),
        (lambda table: table.drop(columns=THRUSTS), f"lacks {', '.join(sorted(PWM))}"),
    ],
)
def test_a_log_that_does_not_fit_is_refused_in_a_line(folder, tmp_path, capsys, change, words):
    change(pd.read_csv(folder / "flight_0.csv")).to_csv(tmp_path / "bad.csv", index=False)
    assert main(["check-vehicle", "crazyflie", "--flights", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1


def test_a_vehicle_in_other_axes_is_refused(folder, capsys):
    assert main(["check-vehicle", "hummingbird", "--flights", str(folder), "-n", "0"]) == 2
    assert "logs are of an X whose rotors turn as those of the Crazyflie" in capsys.readouterr().err


def test_a_folder_without_logs_is_refused_with_the_columns(tmp_path):
    (tmp_path / "flight.ulg").write_bytes(b"ULog")
    with pytest.raises(
        ConfigError, match="no CSV file there; a log is a CSV file with the columns"
    ):
        read_logs(tmp_path, STEP)


@real
def test_the_fitted_file_predicts_flights_that_were_not_fitted():
    """After 0.2 s, at most half as far off as if the velocity stayed."""
    logs = [log for log in read_logs(FOLDER, STEP) if log.flying.any()]
    for time, predictions, end in open_loop(logs[1::2], VEHICLE, stride=3):
        if abs(time - 0.2) < 0.01:
            assert errors(predictions[0], end)[0] < 0.5 * errors(predictions[2], end)[0]


@real
def test_a_log_ends_where_it_was_extrapolated():
    (log,) = [each for each in read_logs(FOLDER, STEP) if "mellinger" in each.path.stem]
    assert log.flying.sum() < 1000
