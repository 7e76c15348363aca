"""The app that `export --format crazyflie` writes: as the firmware calls it, on this machine and on
the Crazyflie's core in QEMU, and in flights of the batch.

``CRAZYFLIE_FIRMWARE=/path/to/crazyflie-firmware`` takes the firmware's own headers and power
distribution instead of the stand-ins in tests/firmware_stubs.
"""

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from test_export import physical_features

from sb3_quad.agents.agent_settings import agent_settings
from sb3_quad.agents.pretrained import agent_path
from sb3_quad.agents.zips import load_model
from sb3_quad.cli import main
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.vec_env import QuadcopterVecEnv
from sb3_quad.envs.vehicles.vehicle import load_vehicle
from sb3_quad.evaluation.flights import fly
from sb3_quad.export.load import load_header
from sb3_quad.export.policy import HEADER, export_policy

HERE = Path(__file__).resolve().parent
STUBS = HERE / "firmware_stubs"
sys.path.insert(0, str(HERE.parent / "examples" / "microcontroller"))
import measure  # type: ignore[import-not-found]  # noqa: E402

CRAZYFLIE = load_vehicle("crazyflie")
FIRMWARE = os.environ.get("CRAZYFLIE_FIRMWARE")
COMPILER = shutil.which("gcc") or shutil.which("clang")
pytestmark = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler here")
on_arm = pytest.mark.skipif(
    shutil.which("arm-none-eabi-gcc") is None or shutil.which("qemu-system-arm") is None,
    reason="gcc-arm-none-eabi or qemu-system-arm is not installed",
)
ABSOLUTE, DISABLED, VELOCITY = 1, 0, 2
# The firmware's headers compile for this machine with these.
HOST = ("-DUNIT_TEST_MODE", "-DSTM32F40_41xxx")
# Modes of x, y, z, roll, pitch, yaw and the quaternion in a setpoint.
POSITION = (ABSOLUTE, ABSOLUTE, ABSOLUTE, DISABLED, DISABLED, ABSOLUTE, DISABLED)
FULL_STATE = (ABSOLUTE, ABSOLUTE, ABSOLUTE, DISABLED, DISABLED, DISABLED, ABSOLUTE)


def includes():
    """Folders of headers, and the power distribution."""
    if FIRMWARE is None:
        headers = STUBS / "headers"
        return [headers, STUBS / "rtos"], headers / "power_distribution_quadrotor.c"
    source = Path(FIRMWARE) / "src"
    parts = ["modules/interface", "modules/interface/controller", "hal/interface", "config"]
    parts += ["utils/interface", "utils/interface/lighthouse", "platform/interface"]
    parts += ["drivers/interface"]
    distribution = source / "modules" / "src" / "power_distribution_quadrotor.c"
    return [STUBS / "rtos", *(source / part for part in parts)], distribution


class App:
    """An exported app as a library, with its variables for each of n vehicles."""

    def __init__(self, folder, flags=(), sources=()):
        folders, distribution = includes()
        # A library that is loaded must not be written over.
        library = Path(tempfile.mkdtemp(dir=folder)) / "app.so"
        command = [COMPILER, "-std=gnu11", "-O2", "-shared", "-fPIC", *HOST, *flags]
        if FIRMWARE is None:
            command += ["-Wall", "-Wextra", "-Werror"]
        command += [f"-I{path}" for path in (*folders, Path(folder) / "src")]
        command += [STUBS / "run.c", distribution, *sources, "-lm", "-o", library]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(done.stderr)
        self.code = ctypes.CDLL(str(library))
        self.code.app_thrust_max.restype = ctypes.c_float
        self.code.app_thrust_min.restype = ctypes.c_float
        self.code.app_count.restype = ctypes.c_long
        self.apps = None

    def __call__(self, rows, fly=1, mode=POSITION, velocity_body=0):
        """Motors' thrusts, N, (n, 2, 4), in the first and the last call of a control step."""
        rows = np.ascontiguousarray(rows, dtype=np.float32)
        if self.apps is None:
            self.apps = np.zeros((len(rows), self.code.app_size()), dtype=np.uint8)
        motors = np.zeros((len(rows), 2, 4), dtype=np.float32)
        arrays = [np.ctypeslib.as_ctypes(array) for array in (rows, self.apps, motors)]
        modes = (ctypes.c_int * 7)(*mode)
        self.code.app_run(
            arrays[0], fly, modes, velocity_body, arrays[1], arrays[2], ctypes.c_long(len(rows))
        )
        return motors


def rows_of(state, speed=0.0, ahead=0.0, yaw=0.0, yaw_rate=0.0):
    """The firmware's state, sensors and setpoint, (n, 24): x y z w, degrees."""
    n = len(state.position)
    columns = [state.position, np.roll(state.quaternion, -1, axis=1), state.velocity]
    columns += [np.degrees(state.body_rates), state.target]
    columns += [np.broadcast_to(value, (n, 3)) for value in (speed, ahead)]
    columns += [np.broadcast_to(np.degrees(value), n)[:, None] for value in (yaw, yaw_rate)]
    return np.hstack(columns)


def states(n, seed=0):
    env = QuadcopterVecEnv(n, "recovery_and_tracking", vehicle="crazyflie", seed=seed)
    env.reset()
    return env.true_state()


@pytest.fixture(scope="module")
def apps(tmp_path_factory):
    """Folders of apps and their exports, by what the policy is."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("apps")
    kinds = {
        "small": ({}, [16, 12]),
        "remembers": ({"history": [0, 2, 5], "last_action": True, "preview": [0, 5]}, [160, 160]),
    }
    made = {}
    for kind, (sees, layers) in kinds.items():
        env = QuadcopterVecEnv(1, vehicle="crazyflie", seed=0, **sees)
        model = PPO("MlpPolicy", env, policy_kwargs={"net_arch": layers}, seed=1, device="cpu")
        with torch.no_grad():  # so that all rotors have something to do
            model.policy.action_net.weight *= 200.0
        FlightSettings(vehicle="crazyflie", **sees).write_into(model)
        model.save(folder / f"{kind}.zip")
        exported = export_policy(folder / f"{kind}.zip", "crazyflie", n_observations=2000)
        made[kind] = (write(exported, folder / kind), exported)
    return made


def write(exported, folder):
    for path, content in exported.files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(content)
    return folder


def header_of(exported, name):
    size = int(exported.metadata.get("state_size", 0))
    return load_header(exported.content, size, name)[0]


@pytest.mark.parametrize("kind", ["small", "remembers"])
def test_it_commands_what_the_header_does(apps, kind):
    """From the firmware's units and axes, also along a reference that moves and turns."""
    folder, exported = apps[kind]
    app, header = App(folder), header_of(exported, kind)
    inputs = int(exported.metadata["observation"].split()[0])
    speed, ahead, yaw, rate = (0.5, -0.3, 0.2), (1.0, 0.5, -0.4), 0.7, 0.4
    memory = None
    references = np.tile(np.float32([*speed, yaw, rate]), (50, 1))
    for step in range(20):
        state = states(50, step)
        rows = rows_of(state, speed, ahead, yaw, rate)
        previews = np.tile(ahead, (50, (inputs - 18) // 3))
        features = np.hstack([physical_features(state), previews]).astype(np.float32)
        motors = app(rows, mode=FULL_STATE if step % 2 else POSITION)
        expected, memory = header(features, memory, references)
        floor = app.code.app_thrust_min() * 1.0003
        np.testing.assert_allclose(motors[:, 1], expected.clip(floor), atol=5e-6)
    assert motors[:, 1].std() > 0.02


def test_the_pid_flies_until_it_is_asked_and_gets_back_what_is_not_a_position(apps):
    folder, exported = apps["remembers"]
    app, header = App(folder), header_of(exported, "remembers")
    state = states(1)
    rows = rows_of(state)
    features = np.hstack([physical_features(state), np.zeros((1, 6), np.float32)])
    assert (app(rows, fly=0) == -1.0).all() and app.code.app_count(0) == 10
    # The policy computes over some calls before its first command. Until then the PID flies.
    first = app(rows)
    assert (first[:, 0] == -1.0).all() and (first[:, 1] >= 0.0).all()
    app(rows)
    for mode in (
        (VELOCITY, VELOCITY, ABSOLUTE, DISABLED, DISABLED, ABSOLUTE, DISABLED),
        (ABSOLUTE, ABSOLUTE, DISABLED, DISABLED, DISABLED, ABSOLUTE, DISABLED),
        (ABSOLUTE, ABSOLUTE, ABSOLUTE, DISABLED, DISABLED, VELOCITY, DISABLED),
        (DISABLED,) * 7,
    ):
        app(rows)
        resets = app.code.app_count(1)
        assert (app(rows, mode=mode) == -1.0).all()
        stopped = 10 * (mode == (DISABLED,) * 7)
        assert app.code.app_count(1) == resets + 1 + stopped  # the PID begins anew, once
        # The policy's state begins anew, too.
        again = app(rows)
        np.testing.assert_array_equal(again, first)
        np.testing.assert_allclose(again[:, 1], header(features.copy(), None)[0], atol=5e-6)
    assert (app(rows, velocity_body=1) == -1.0).all()
    broken = rows.copy()
    broken[0, 0] = np.nan
    assert (app(broken) == -1.0).all()
    np.testing.assert_array_equal(app(rows), first)


def test_a_platform_that_is_too_weak_does_not_compile(apps, tmp_path):
    exported = export_policy(
        apps["small"][0].parent / "small.zip", "crazyflie", vehicle="cf21B_500", n_observations=50
    )
    folder = write(exported, tmp_path)
    assert "for Crazyflie 2.1 Brushless" in exported.metadata["app"]
    App(folder, ["-DBRUSHLESS"])
    with pytest.raises(RuntimeError, match="more than THRUST_MAX"):
        App(folder)


class Firmware:
    """The app where an expert may be: it gets the true state in the firmware's units."""

    def __init__(self, app):
        self.app = app

    def actions(self, state):
        motors = self.app(rows_of(state), mode=POSITION)[:, 1]
        assert (motors >= 0.0).all()
        return CRAZYFLIE.thrust_to_action(motors.astype(float)).clip(-1.0, 1.0)


@pytest.mark.parametrize(
    ("name", "n"),
    [("crazyflie-recovery", 24), pytest.param("any-quadcopter", 8, marks=pytest.mark.slow)],
)
def test_it_recovers_as_its_zip(tmp_path, name, n):
    """In the same n recoveries, without noise; the second agent has a state."""
    exported = export_policy(agent_path(name), "crazyflie", vehicle="crazyflie")
    settings, _ = agent_settings(agent_path(name))
    sees = dict(settings.observation)
    firmware = Firmware(App(write(exported, tmp_path)))
    zipped, flown = (
        fly(each, "state_recovery", n, 600, CRAZYFLIE, 0.0, **sees).success.sum()
        for each in (load_model(agent_path(name)), firmware)
    )
    assert zipped >= n - 1 and abs(zipped - flown) <= 1


@on_arm
@pytest.mark.parametrize("kind", ["small", "remembers"])
def test_the_microcontroller_computes_the_same(apps, tmp_path, kind):
    """A thousand control steps of 10 calls, in QEMU and here."""
    folder, exported = apps[kind]
    check_on_arm(folder, exported, tmp_path)


def check_on_arm(folder, exported, tmp_path):
    """Thrusts within 2e-7 N, and no call longer than half of the firmware's."""
    rows_of(states(1000)).astype(np.float32).tofile(tmp_path / "in.bin")
    folders, distribution = includes()
    sources = [STUBS / "run.c", distribution]
    flags = ["-Os", *HOST]
    program = measure.build(tmp_path, sources, flags, [*folders, folder / "src"])
    calls, instructions, longest = measure.run(program)
    there = np.fromfile(tmp_path / "out.bin", np.float32)
    here = tmp_path / "here"
    command = [COMPILER, "-O2", *flags[1:], *(f"-I{path}" for path in (*folders, folder / "src"))]
    subprocess.run([*command, *sources, "-lm", "-o", here], check=True)
    subprocess.run([here], cwd=tmp_path, check=True, capture_output=True)
    # The forces are fractions of THRUST_MAX.
    error = 0.12 * np.abs(there - np.fromfile(tmp_path / "out.bin", np.float32)).max()
    print(f"{calls} steps, {instructions} instructions, longest call {longest}, {error:.1e} N")
    assert int(calls) == 1000 and there.size == 4000 and there.std() > 0.05
    assert error <= 2e-7
    assert int(longest) < 84_000
    # What the file says of itself, and what the ten calls of the firmware add.
    thousands = int(exported.metadata["cost"].split(" thousand")[0].split()[-1])
    assert 1000 * thousands == pytest.approx(float(instructions), rel=0.05, abs=6000)


@pytest.mark.parametrize(
    ("arguments", "key"),
    [
        (["--output", "speeds"], "--output"),
        (["--vehicle", "itm"], "itm"),
        (["--vehicle", "slow.yaml"], "control_step"),
        ([], "--overwrite"),
    ],
)
def test_what_no_crazyflie_flies_is_one_line(apps, tmp_path, monkeypatch, capsys, arguments, key):
    monkeypatch.chdir(tmp_path)
    lines = CRAZYFLIE.model_dump(mode="json", exclude={"geometric_gains", "time_optimal", "rates"})
    lines.update(control_step=0.0105, physics_step=0.0015)
    Path("slow.yaml").write_text("\n".join(f"{name}: {value}" for name, value in lines.items()))
    Path("app", "src").mkdir(parents=True)
    Path("app", HEADER).touch()
    folder = "app" if not arguments else "other"
    model = str(apps["small"][0].parent / "small.zip")
    assert main(["export", model, "--format", "crazyflie", "-o", folder, *arguments]) == 2
    assert key in capsys.readouterr().err.splitlines()[-1]
    assert not Path("other").exists()


def test_the_rotors_of_another_order_become_the_firmwares(apps, tmp_path):
    order = [2, 3, 0, 1]
    other = CRAZYFLIE.model_copy(
        update={
            "rotor_positions": [CRAZYFLIE.rotor_positions[k] for k in order],
            "rotor_directions": [CRAZYFLIE.rotor_directions[k] for k in order],
        }
    )
    folder, exported = apps["small"]
    zip_file = folder.parent / "small.zip"
    turned = export_policy(zip_file, "crazyflie", vehicle=other, n_observations=50)
    assert turned.metadata["rotors"] == exported.metadata["rotors"]
    rows = rows_of(states(100))
    app = App(write(turned, tmp_path))
    np.testing.assert_array_equal(app(rows), App(folder)(rows))


def test_the_command_writes_the_folder_and_says_what_it_costs(apps, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    model = str(apps["small"][0].parent / "small.zip")
    assert main(["export", model, "--format", "crazyflie"]) == 0
    printed = capsys.readouterr().out
    assert "saved small_crazyflie " in printed and Path("small_crazyflie", HEADER).exists()
    flash = 4 * (18 * 16 + 16 + 16 * 12 + 12 + 12 * 4 + 4 + 2 * 18)
    assert f"cost: {flash:,} bytes of flash, 0 of RAM" in printed
    assert "528 multiplications" in printed and "fits STM32F405 (Cortex-M4): 0.0" in printed
    assert "app: 0.02 to 0.1125 N a rotor, for Crazyflie 2.x" in printed
