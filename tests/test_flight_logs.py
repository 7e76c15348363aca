"""Logs of real flights: read, flown open loop, and fitted.

Logs that our own simulator wrote give back the parameters it flew with.
"""

import sys
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import yaml
from log_writers import write_blackbox, write_plain, write_ulog, write_usd
from scipy.spatial.transform import Rotation

from sb3_quad import GeometricExpert, QuadcopterVecEnv, load_vehicle
from sb3_quad.base.errors import ConfigError, MissingExtra
from sb3_quad.cli import main
from sb3_quad.envs.simulation.state import QUATERNION, VELOCITY
from sb3_quad.envs.vehicles.vehicle import GRAVITY
from sb3_quad.identification import fit_vehicle, read_logs
from sb3_quad.identification.alignment import mounting
from sb3_quad.identification.curve import Curve, refuse_other_order
from sb3_quad.identification.flight_log import attitudes, quaternions
from sb3_quad.identification.open_loop import gaps, log_thrusts, open_loop
from sb3_quad.identification.readers import THRUST_BY_VOLTAGE, motor_thrusts
from sb3_quad.identification.smoothing import smoothed

CAPTURE_COLUMNS = ["px", "py", "pz", "qw", "qx", "qy", "qz", "vx", "vy", "vz"]
GYRO_COLUMNS = ["gyro_x", "gyro_y", "gyro_z"]
THRUSTS = ["thrust_m1", "thrust_m2", "thrust_m3", "thrust_m4"]
STEP = 0.01
VEHICLE = load_vehicle("crazyflie_nanobench")


def along(curve, vehicle, seed, **keywords):
    """One vehicle without noise, on a curve of 2 m/s."""
    keywords |= {"noise": 0.0, "reference": {"curve": curve, "speed": 2.0}}
    return QuadcopterVecEnv(1, "target_tracking", vehicle=vehicle, seed=seed, **keywords)


def flown(seed, seconds=6.0):
    """Return a log of flights to targets, as a table with thrusts in N."""
    env = along("figure_eight", VEHICLE, seed)
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
    attitude = [Rotation.identity()]
    for rotation in 0.5 * STEP * (rates[1:] + rates[:-1]):
        attitude.append(attitude[-1] * Rotation.from_rotvec(rotation))
    table = pd.DataFrame({"t": time, **dict.fromkeys(CAPTURE_COLUMNS, 0.0)})
    table["pz"] = 1.0
    table[["qx", "qy", "qz", "qw"]] = np.array([one.as_quat() for one in attitude])
    table[GYRO_COLUMNS] = rates
    return table.assign(**dict.fromkeys(THRUSTS, 0.1))


def read_back(table, folder):
    table.to_csv(folder / "flight.csv", index=False)
    return read_logs(folder, STEP)[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs")
    for seed in (0, 1):
        flown(seed).to_csv(path / f"flight_{seed}.csv", index=False)
    return path


def test_our_own_log_flown_again_is_nearly_the_same_flight(folder):
    # The calibration of motors and markers, which need none here, costs a little.
    errors = open_loop(read_logs(folder, STEP), VEHICLE, Curve("thrust", np.ones(1)))
    assert (errors[:, 0] < 0.7 * errors[:, 1]).all()


@pytest.mark.parametrize("late", [0, 3])
@pytest.mark.parametrize("turn", [0.0, -3.0])
def test_the_clock_is_found_while_the_vehicle_turns(tmp_path, turn, late):
    table = turning(turn=turn)
    table[GYRO_COLUMNS] = table[GYRO_COLUMNS].shift(late).bfill()
    assert read_back(table, tmp_path).offset == pytest.approx(late * STEP, abs=0.002)


@pytest.mark.parametrize("missing", [2, 7])
def test_nothing_is_known_within_a_long_gap(tmp_path, missing):
    table = turning()
    flying = read_back(table.drop(range(200, 200 + missing)), tmp_path).flying[:-1]
    is_long = (missing + 1) * STEP > 0.05
    assert not flying[200 : 200 + missing].any() if is_long else flying.all()
    assert flying[:198].all() and flying[201 + missing :].all()


def test_a_quaternion_and_its_negative_are_one_attitude(tmp_path):
    table = turning()
    expected = read_back(table, tmp_path).motion
    signs = np.random.default_rng(0).choice([-1.0, 1.0], (len(table), 1))
    table[CAPTURE_COLUMNS[QUATERNION]] *= signs
    found = read_back(table, tmp_path).motion[:, QUATERNION]
    cosines = (found * expected[:, QUATERNION]).sum(axis=1)
    np.testing.assert_allclose(cosines, cosines[0], atol=1e-9)


def test_drag_at_a_mean_velocity_is_no_tilt_of_the_markers():
    random = np.random.default_rng(0)
    body = Rotation.from_rotvec(0.2 * random.standard_normal((500, 3)))
    velocity = random.normal([1.0, 0.5, 0.0], 1.0, (500, 3))
    drag = body.apply(0.3 * body.inv().apply(velocity))
    force = body.apply([0.0, 0.0, GRAVITY]) - drag
    tilt = Rotation.from_rotvec([0.02, -0.03, 0.0])
    found = mounting(body * tilt.inv(), velocity, force)
    np.testing.assert_allclose(found.as_rotvec(), tilt.as_rotvec(), atol=1e-3)


def test_smoothing_takes_noise_away_and_keeps_fast_turns(tmp_path):
    table = turning()
    clean = read_back(table, tmp_path)
    noise = 0.02 * np.random.default_rng(0).standard_normal((2, len(clean.motion), 3))
    noisy = clean.motion.copy()
    noisy[:, VELOCITY] += noise[0]
    noisy[:, QUATERNION] = quaternions(attitudes(noisy) * Rotation.from_rotvec(noise[1]))
    for motion, most in ((clean.motion, 0.002), (noisy, 0.008)):
        position, velocity, turn, _ = gaps(smoothed(replace(clean, motion=motion)), clean.motion)
        assert np.std([velocity, turn]) < most and np.std(position) < most


def test_pwm_becomes_the_thrust_that_the_firmware_expects():
    shares = np.array([[0.0, 1.0, 1.0, 1.0, 0.5], [1.0] * 4 + [0.0], [2.0] + [1.0] * 3 + [1.1]])
    ((time, *thrusts),) = motor_thrusts(shares, np.array([[0.0, 3.4]]))
    expected = sum(c * 3.4**k for k, c in enumerate(THRUST_BY_VOLTAGE))
    assert time == 0.0 and 0.15 < expected < 0.16
    assert thrusts[0] == pytest.approx(expected) and 0.0 < thrusts[3] < expected


def test_check_vehicle_prints_the_errors(folder, capsys):
    assert main(["check-vehicle", "crazyflie_nanobench", "--flights", str(folder)]) == 0
    assert "after 0.2 s" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda table: table.drop(columns=["qw"]), "accelerometer"),
        (lambda table: table.assign(qw="a"), "attitude: 200 of 200 rows"),
        (lambda table: table[:1], "bad.csv"),
        (lambda table: table.assign(t=table["t"].where(table.index != 8, 0.01)), "runs back"),
        (lambda table: table.assign(pz=0.0), "0.3 m"),
        (lambda table: table.drop(columns=THRUSTS), "motor commands"),
        # In other units, axes or orders, or damaged
        (lambda table: table.assign(t=1e6 * table["t"]), "unit"),
        (lambda table: table.assign(t=table["t"].where(table.index < 199, 1e300)), "unit"),
        (lambda table: table[:50], "shorter than 1 s"),
        (lambda table: table.assign(gyro_x=57.3 * table["gyro_x"]), "gyro x"),
        (lambda table: table.assign(gyro_z=-table["gyro_z"]), "gyro z"),
        (lambda table: table.assign(px=1000.0 * np.sin(table["t"])), "velocity x"),
        (lambda table: table.assign(vy=1e300), "velocity"),
        (lambda table: table.assign(qw=table["qw"].where(table.index != 8, 9.0)), "row 9: qw"),
        (lambda table: table.assign(thrust_m2=-0.1), "M2"),
        (lambda table: table.assign(thrust_m2=1e300), "thrust"),
        (lambda table: table.assign(thrust_m2=1.5e3), "M2"),
        (lambda table: table.assign(gyro_y=table["gyro_y"].where(table.index < 99, 400)), "gyro"),
        (lambda table: table.rename(columns={"vz": "vx"}), "twice"),
        (lambda table: table.assign(acc_x=0.0, acc_y=0.0, acc_z=1.0), "accelerometer"),
    ],
)
def test_a_log_that_does_not_fit_is_refused_in_a_line(tmp_path, capsys, change, named):
    change(turning(2.0)).to_csv(tmp_path / "bad.csv", index=False)
    assert main(["check-vehicle", "crazyflie", "--flights", str(tmp_path), "-n", "0"]) == 2
    error = capsys.readouterr().err
    assert named in error and error.count("\n") == 1


@pytest.mark.parametrize(
    ("column", "rows", "value", "note"),
    [
        ("gyro_x", slice(None, None, 10), np.nan, "60 of 600 rows"),
        ("thrust_m2", slice(300, 301), 1e4, "2 of 600 rows"),
    ],
)
def test_rows_that_hold_no_number_or_glitches_are_left_out_and_named(
    tmp_path, column, rows, value, note
):
    table = turning()
    table.loc[rows, column] = value
    log = read_back(table, tmp_path)
    assert log.flying.mean() > 0.95 and note in log.notes[0]
    assert log.mean_commands().max() < 0.11


def test_on_the_ground_nothing_counts(table, tmp_path):
    still = table.copy()
    half = len(table) // 2
    still.loc[:half, ["share_1", "share_2", "share_3", "share_4"]] = 0.2
    still.loc[:half, [*GYRO_COLUMNS, "acc_x", "acc_y", "acc_z"]] = [0.0] * 5 + [9.81]
    write_plain(tmp_path / "log", still)
    (log,) = read_logs(tmp_path / "log")
    assert not log.flying[:half].any() and log.flying[half + 110 : -1].all()


def shaken(vehicle, seconds=10.0, seed=0):
    """Return a table as :mod:`log_writers` takes it, of a flight whose commands are shaken."""
    env = along("lissajous", vehicle, seed, max_episode_steps=100_000)
    expert = GeometricExpert(vehicle)
    random = np.random.default_rng(seed)
    env.reset()
    rows = []
    for now in range(round(seconds / vehicle.control_step)):
        state = env.true_state()
        actions = expert.actions(state) + 0.15 * random.standard_normal((1, 4)) * (now % 10 < 5)
        shares = np.sqrt(vehicle.action_to_thrust(actions[0]) / vehicle.thrust_range[1])
        force = [0.0, 0.0, state.specific_force[0, 2]]
        parts = ([now * vehicle.control_step], state.body_rates[0], force, shares)
        rows.append(np.concatenate(parts))
        env.step(np.clip(actions, -1.0, 1.0))
    names = ["t", *GYRO_COLUMNS, "acc_x", "acc_y", "acc_z"]
    return pd.DataFrame(rows, columns=[*names, *(f"share_{k}" for k in (1, 2, 3, 4))])


def stepped(vehicle, **changes):
    """Return a vehicle whose control steps are as short as a log's."""
    changes = {"control_step": 0.005, "delay": 2, "motor_integration": "exact", **changes}
    return vehicle.model_copy(update=changes)


@pytest.fixture(scope="module")
def table():
    return shaken(stepped(load_vehicle("crazyflie")), seconds=6.0)


@pytest.mark.parametrize(
    ("write", "order", "accuracy"),
    [
        (write_plain, "", 1e-6),
        (write_usd, "crazyflie", 1e-4),
        (write_ulog, "px4", 1e-4),
        (write_blackbox, "betaflight", 0.02),
    ],
)
def test_each_format_is_read_in_the_same_units_and_axes(table, tmp_path, write, order, accuracy):
    write(tmp_path / "log", table)
    (log,) = read_logs(tmp_path / "log")
    assert (log.order, log.kind, log.has_motion, log.step) == (order, "share", False, 0.005)
    rows = slice(20, 1100)
    np.testing.assert_allclose(log.motion[rows, -3:], table[GYRO_COLUMNS][rows], atol=accuracy)
    np.testing.assert_allclose(log.force[rows, 2], table["acc_z"][rows], atol=accuracy)
    commands = table[[f"share_{k}" for k in (1, 2, 3, 4)]][rows]
    np.testing.assert_allclose(log.mean_commands()[rows], commands, atol=accuracy)


def test_a_log_that_was_cut_is_read_to_its_end(table, tmp_path):
    for number, write in enumerate((write_usd, write_ulog, write_blackbox)):
        path = tmp_path / str(number)
        write(path, table)
        path.write_bytes(path.read_bytes()[: -path.stat().st_size // 3])
        (log,) = read_logs(path)
        assert 3.5 < len(log.flying) * log.step < 4.5


def test_a_format_whose_package_is_missing_names_the_extra(table, tmp_path, monkeypatch):
    write_ulog(tmp_path / "log.ulg", table[:10])
    monkeypatch.setitem(sys.modules, "pyulog", None)
    with pytest.raises(MissingExtra, match=r"\[fit\]"):
        read_logs(tmp_path / "log.ulg")


def test_motors_in_another_order_are_refused_with_the_one_that_fits(table, tmp_path):
    write_plain(tmp_path / "log", table)
    (log,) = read_logs(tmp_path / "log")
    vehicle = load_vehicle("crazyflie")
    thrusts = log.mean_commands() ** 2
    refuse_other_order([log], vehicle, thrusts)
    with pytest.raises(ConfigError, match=r"roll.*\[4, 3, 2, 1\]"):
        refuse_other_order([log], vehicle, thrusts[:, [3, 2, 1, 0]])
    with pytest.raises(ConfigError, match="pitch"):
        refuse_other_order([log], vehicle, thrusts[:, [1, 2, 3, 0]])
    other = vehicle.model_copy(update={"rotor_directions": [1, -1, 1, -1]})
    with pytest.raises(ConfigError, match=r"yaw.*rotor_directions"):
        refuse_other_order([log], other, thrusts)


def test_commands_that_a_rotor_cannot_follow_are_no_mean_moment(table, tmp_path):
    vehicle = stepped(load_vehicle("crazyflie"))
    calm = table.copy()
    calm.loc[:, calm.columns != "t"] = [0.0, 0.0, 0.0, 0.0, 0.0, GRAVITY, 0.7, 0.7, 0.7, 0.7]
    calm["share_1"] += 0.1 * (-1.0) ** calm.index.to_numpy()
    write_plain(tmp_path / "log", calm)
    (log,) = read_logs(tmp_path / "log")
    curve = Curve("share", np.array([0.0, 0.0, vehicle.thrust_range[1]]))
    commanded = curve.thrust(log.mean_commands())
    thrusts = log_thrusts([log], vehicle, curve)
    np.testing.assert_allclose(thrusts, commanded, rtol=0.004)


@pytest.mark.slow
def test_the_fit_gives_back_what_flew(tmp_path):
    flew = stepped(load_vehicle("crazyflie"))
    write_usd(tmp_path / "log", shaken(flew, 20.0))
    start = flew.model_copy(update={"motor_gain": 25.0, "inertia": [1.2e-5, 1.2e-5, 2.1e-5]})
    fit = fit_vehicle(read_logs(tmp_path / "log"), start)
    assert fit.vehicle.delay == flew.delay
    np.testing.assert_allclose(fit.vehicle.motor_gain_up, flew.motor_gain_up, rtol=0.05)
    np.testing.assert_allclose(fit.vehicle.inertia, flew.inertia, rtol=0.05)
    commands = np.array([0.5, 0.8])
    expected = flew.thrust_range[1] * commands**2
    np.testing.assert_allclose(fit.curve.thrust(commands), expected, rtol=0.05)
    held = {one.field: one.reason for one in fit.estimates.itertuples() if one.reason}
    assert "no velocity" in held["drag"]
    # What a motor does at its least command, no flight tells.
    assert fit.vehicle.thrust_range[0] == pytest.approx(start.thrust_range[0])


@pytest.mark.slow
def test_a_gyro_in_another_unit_is_refused_by_the_inertia(table, tmp_path):
    other = table.copy()
    other[GYRO_COLUMNS] /= 9.81
    write_plain(tmp_path / "log", other)
    with pytest.raises(ConfigError, match="gyro's unit"):
        fit_vehicle(read_logs(tmp_path / "log"), load_vehicle("crazyflie"))


@pytest.mark.slow
def test_the_command_writes_a_vehicle_file_and_a_picture(folder, tmp_path, capsys):
    output = tmp_path / "mine.yaml"
    command = ["fit", str(folder), "--vehicle", "crazyflie_nanobench", "-o", str(output)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert "airspeed_moment" in printed and "after 0.2 s" in printed
    assert (tmp_path / "mine.png").stat().st_size > 10_000
    assert "±" in output.read_text() and load_vehicle(output).name == "mine"
    assert yaml.safe_load(output.read_text())["mass"] == VEHICLE.mass
    assert main(command) == 2


def damaged(content, random):
    """Return a log with some of its bytes changed, cut out, or twice."""
    content = bytearray(content)
    for _ in range(random.integers(1, 20)):
        place = int(random.integers(len(content)))
        size = int(random.choice([1, 8, 300]))
        if random.random() < 0.5:
            content[place : place + size] = random.bytes(size)
        else:
            content[place : place + size] = b""
    return bytes(content[: random.integers(1, len(content))])


@pytest.mark.parametrize("count", [10, pytest.param(50, marks=pytest.mark.slow)])
def test_damaged_logs_are_read_or_refused_in_a_line(table, tmp_path, count):
    random = np.random.default_rng(count)
    for write in (write_plain, write_usd, write_ulog, write_blackbox):
        write(tmp_path / "whole", table[:150])
        content = (tmp_path / "whole").read_bytes()
        for number in range(count):
            (tmp_path / str(number)).write_bytes(damaged(content, random))
            # Anything but a refusal fails.
            with suppress(ConfigError):
                read_logs(tmp_path / str(number))
