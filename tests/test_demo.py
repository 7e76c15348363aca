"""The page of ``sb3-quad demo``: its model flies what Python flies, it reads zips, and in a browser
it can be thrown.
"""

import dataclasses
import functools
import json
import math
import os
import re
import shutil
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from hovering import teach_to_hover
from stable_baselines3 import A2C, PPO, SAC, TD3

from sb3_quad.agents.agent_settings import env_kwargs
from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import STATE_SIZE, X
from sb3_quad.envs.vehicles.layout import NamedLayout, find_turn
from sb3_quad.envs.vehicles.vehicle import VEHICLES, load_vehicle
from sb3_quad.evaluation.controllers import parse_controllers
from sb3_quad.evaluation.flights import fly as fly_flights
from sb3_quad.show.demo import page as page_module
from sb3_quad.show.demo.page import (
    DEFAULT_AGENTS,
    MODEL,
    describe,
    join_modules,
    make_page,
    script,
)

STEPS = 1000  # control steps
NODE = shutil.which("node")
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
HARNESS = """
const { readFileSync } = await import("node:fs");
const job = JSON.parse(readFileSync(0, "utf8"));
let agent = job.agent ?? { label: "given", kind: "pid" };
if (agent.shapes) agent.layers = await unpackLayers(agent);
if (job.zip) {
  const bytes = new Uint8Array(readFileSync(job.zip));
  try {
    agent = (await readAgent("dropped", bytes.buffer)).agent;
  } catch (error) {
    console.log(JSON.stringify(error.message));
    process.exit();
  }
}
if (job.observations) {
  const results = job.observations.map((row) => forward(agent.layers, Float32Array.from(row)));
  console.log(JSON.stringify(results.map((row) => [...row])));
  process.exit();
}
const flight = new Flight(job.vehicle, agent);
if (job.world) flight.setWorld(job.world, 0);
flight.begin(job.start);
if (job.drawn) {
  const course = new Course(job.drawn, job.start.target, job.limits);
  const rows = Array.from({ length: job.steps }, (_, k) => course.at(k * job.limits.dt));
  await new Promise((done) => process.stdout.write(JSON.stringify(rows), done));
  process.exit();
}
const dt = job.vehicle.control_step;
if (job.rows) flight.follow({ at: (time) => job.rows[Math.round(time / dt)] });
const path = [];
for (let k = 0; k < job.steps; k++) {
  flight.step({ ...NO_WRENCH, ...job.wrench }, job.actions ? job.actions[k] : flight.act());
  path.push([...flight.state]);
}
console.log(JSON.stringify(path));
"""

# One step of the training's physics beside that of the page, its adjoint beside differences, or a
# whole training.
LEARNING = """
const job = JSON.parse((await import("node:fs")).readFileSync(0, "utf8"));
const p = new Training(job.vehicle, job.seed).p;
const answers = {
  step() {
    // Alone, and as the second of two
    const ours = Float64Array.from([...job.state, ...job.state]);
    const theirs = Float64Array.from(job.state);
    physicsStep(ours, [0, 0, 0, 0, ...job.wanted], p, NO_WRENCH, STATE_SIZE, 4);
    physicsStep(theirs, job.wanted, p, NO_WRENCH);
    return [[...ours.subarray(STATE_SIZE)], [...theirs]];
  },
  undo() {
    const moved = Float64Array.from(job.by), byWanted = new Float64Array(4);
    undo(Float64Array.from(job.state), 0, Float64Array.from(job.wanted), byWanted, 0, moved, p);
    return [...moved, ...byWanted];
  },
  learn() {
    let last = [];
    train(job, ({ numbers }) => (last = [...numbers]));
    return last;
  },
};
const text = JSON.stringify(answers[job.what]());
await new Promise((done) => process.stdout.write(text, done));
"""

node = pytest.mark.skipif(NODE is None, reason="there is no node on this machine")
chromium = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")


def in_node(tmp_path, harness=HARNESS, **job):
    """What the page's model answers, without a browser."""
    file = tmp_path / "model.mjs"
    file.write_text(script(MODEL) + harness)
    done = subprocess.run(
        [NODE, str(file)], input=json.dumps(job), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def start_of(env):
    """The start of the episode of an environment's only row."""
    state = env.true_state()
    names = ("position", "quaternion", "velocity", "body_rates", "target")
    return {name: getattr(state, name)[0].tolist() for name in names}


def fly(env, actions, steps=STEPS):
    """The states, (steps, 20), that follow the present one; ``actions(observation, step)``."""
    observation, path = env.observe(), []
    for step in range(steps):
        observation, _, dones, _ = env.step(actions(observation, step))
        assert not dones[0]
        path.append(env.true_state().array[:, 0].copy())
    return np.array(path)


def apart(ours, theirs):
    """The largest distance between two paths, m."""
    return np.linalg.norm(np.array(ours)[:, :3] - theirs[:, :3], axis=1).max()


class Env(QuadcopterVecEnv):
    """One row that begins its first episode, without noise."""

    def __init__(self, **keywords):
        super().__init__(
            1, max_episode_steps=10 * STEPS, seed=5, n_threads=1, **{"noise": 0.0, **keywords}
        )
        self.first = self.reset()

    def observe(self):
        return self.first


BREEZY = {
    "drag": (0.3, 0.4, 0.2),
    "motor_gain_up": 30.0,
    "motor_gain_down": 12.0,
    "motor_integration": "exact",
}
WORLD = {"mass": 1.2, "motor_gain": 0.7, "thrust": 0.9}
BATTERY = NamedLayout(rotor_order="px4", arm_length=0.24, center_of_mass=(-0.03, 0.01)).rotors()


def vehicle_called(name):
    """A shipped vehicle, or ITM in wind, in another world, or with its battery elsewhere."""
    if name in VEHICLES.names():
        return load_vehicle(name)
    changes = {"breezy": BREEZY, "battery": {**BATTERY, "thrust_coefficient": 0.0}}.get(name, {})
    return load_vehicle("itm").model_copy(update=changes)


@node
@pytest.mark.slow
@pytest.mark.parametrize("name", [*VEHICLES.names(), "breezy", "other world", "battery"])
def test_given_actions_lead_to_where_python_flies(name, tmp_path):
    vehicle = vehicle_called(name)
    task = {"start_position": (0.0, 0.0, 5000.0), "max_distance": 1e6}
    random = (
        {key: [value, value] for key, value in {**WORLD, "delay": 3}.items()}
        if name == "other world"
        else None
    )
    env = Env(task="recovery_and_tracking", vehicle=vehicle, task_kwargs=task, randomize=random)
    wrench = {"force": [0.2, -0.1, 0.3], "torque": [1e-4, -2e-4, 1e-4], "wind": [3.0, -2.0, 0.5]}
    env.set_wrench(wrench["force"], wrench["torque"])
    env.set_wind(wrench["wind"])
    walk = np.cumsum(0.03 * np.random.default_rng(0).standard_normal((STEPS, 4)), axis=0)
    actions = np.clip(vehicle.hover_action + walk, -1, 1).astype(np.float32)
    world = {"mass": 1.2, "motors": 0.7, "thrust": 0.9, "delay": 3} if random else None
    job = {
        "vehicle": vehicle.model_dump(mode="json"),
        "start": start_of(env),
        "wrench": wrench,
        "world": world,
    }
    path = in_node(tmp_path, **job, steps=STEPS, actions=actions.astype(float).tolist())
    assert apart(path, fly(env, lambda _, step: actions[[step]])) <= 1e-9


@node
@pytest.mark.slow
@pytest.mark.parametrize("name", [*VEHICLES.names(), "battery"])
@pytest.mark.parametrize("expert", ["pid", "geometric", "derived"])
def test_the_experts_fly_as_in_python(expert, name, tmp_path):
    vehicle = vehicle_called(name)
    if expert == "derived":
        vehicle = vehicle.model_copy(update={"geometric_gains": None})
    kind = "pid" if expert == "pid" else "geometric"
    env, law = Env(task="state_recovery", vehicle=vehicle), resolve_expert(kind, vehicle)
    agent = {"label": kind, "kind": kind}
    path = in_node(
        tmp_path,
        vehicle=vehicle.model_dump(mode="json"),
        agent=agent,
        start=start_of(env),
        steps=STEPS,
    )
    assert apart(path, fly(env, lambda *_: law.actions(env.true_state()))) <= 1e-6


AGENTS = ["itm-imitation", "itm-recovery", "itm-robust", "any-quadcopter"]
ANY_PLUS = "any-quadcopter", "hummingbird"


@node
@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "task"),
    [
        ("float32", "state_recovery"),
        ("float32", "target_tracking"),
        ("float16", "state_recovery"),
        ("zip", "target_tracking"),
    ],
)
@pytest.mark.parametrize(
    ("name", "vehicle"),
    [*((name, "itm") for name in AGENTS), ("any-quadcopter", "crazyflie"), ANY_PLUS],
)
def test_the_agents_fly_as_in_python(name, vehicle, how, task, tmp_path, monkeypatch):
    """Exact weights, those rounded to half precision (also in Python), and those that the page
    reads from the zip itself.
    """
    (spec,), flown = parse_controllers([name]), load_vehicle(vehicle)
    model = PPO.load(pretrained_path(name), device="cpu")
    monkeypatch.setattr(page_module, "EXACT", 0 if how == "float16" else 10**6)
    agent = {"label": name, **describe(spec)}
    assert agent["bits"] == (16 if how == "float16" else 32)
    if how == "float16":
        own = *model.policy.mlp_extractor.policy_net, model.policy.action_net
        layers = [part for layer in own for part in layer.parameters()]
        for part in layers:
            part.data = part.data.half().float()
    env = Env(
        **{**env_kwargs(name), "task": task, "vehicle": flown, "noise": 0.0, "vehicles": None}
    )
    start, turn = start_of(env), find_turn(flown, spec.own.layout)
    if (
        turn.angle
    ):  # the page flies the vehicle in its own axes, Python in those that the agent knows
        w, x, y, z = start["quaternion"]
        c, s = math.cos(turn.angle / 2), math.sin(turn.angle / 2)
        start["quaternion"] = [w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s]
        start["body_rates"] = (turn.axes.T @ start["body_rates"]).tolist()
    source = {"zip": str(pretrained_path(name))} if how == "zip" else {"agent": agent}
    path = in_node(
        tmp_path, vehicle=flown.model_dump(mode="json"), **source, start=start, steps=STEPS
    )
    flight = fly(env, lambda observation, _: model.predict(observation, deterministic=True)[0])
    assert apart(path, flight) <= 1e-4
    assert np.linalg.norm(flight[-1, :3] - flight[-1, 17:20]) < 0.1


def reference_rows(env):
    """The reference of an environment's only row at each step, and somewhat beyond the flight."""
    table = env.batch.tracks.copy()
    table[:, :3] += env.true_state().target[0]
    return [table[k % len(table)].tolist() for k in range(STEPS + 40)]


@node
@pytest.mark.slow
@pytest.mark.parametrize("name", ["itm", "crazyflie"])
@pytest.mark.parametrize("kind", ["pid", "geometric"])
def test_the_experts_follow_a_reference_as_in_python(kind, name, tmp_path):
    vehicle = load_vehicle(name)
    env = Env(task="target_tracking", vehicle=vehicle, reference="figure_eight")
    law = resolve_expert(kind, vehicle)
    path = in_node(
        tmp_path,
        vehicle=vehicle.model_dump(mode="json"),
        agent={"label": kind, "kind": kind},
        start=start_of(env),
        rows=reference_rows(env),
        steps=STEPS,
    )
    flight = fly(env, lambda *_: law.actions(env.true_state()))
    assert apart(path, flight) <= 1e-6


def previewing(tmp_path):
    """An agent that previews its reference, and hovers by the weights of one of the package."""
    model = PPO(
        "MlpPolicy",
        QuadcopterVecEnv(1, reference="figure_eight", preview=[0, 5]),
        policy_kwargs={"net_arch": [64, 64]},
        device="cpu",
        seed=0,
    )
    teach_to_hover(model, std=0.05)
    FlightSettings(preview=[0, 5]).write_into(model)
    model.save(tmp_path / "previewing.zip")
    return str(tmp_path / "previewing.zip")


@node
@pytest.mark.slow
@pytest.mark.parametrize("how", ["described", "zip"])
@pytest.mark.parametrize("name", ["itm-robust", "previewing"])
def test_the_agents_follow_a_reference_as_in_python(name, how, tmp_path, monkeypatch):
    """A figure eight with a heading that turns: the frame of the observation turns with it."""
    monkeypatch.setattr(page_module, "EXACT", 10**6)
    zip_file = previewing(tmp_path) if name == "previewing" else str(pretrained_path(name))
    (spec,) = parse_controllers([zip_file])
    model = PPO.load(zip_file, device="cpu")
    curve = {"curve": "figure_eight", "speed": 1.5, "heading": 0.3, "heading_rate": 0.4}
    env = Env(
        **{**env_kwargs(zip_file), "task": "target_tracking", "noise": 0.0, "reference": curve}
    )
    source = {"zip": zip_file} if how == "zip" else {"agent": {"label": name, **describe(spec)}}
    path = in_node(
        tmp_path,
        vehicle=load_vehicle("itm").model_dump(mode="json"),
        **source,
        start=start_of(env),
        rows=reference_rows(env),
        steps=STEPS,
    )
    flight = fly(env, lambda observation, _: model.predict(observation, deterministic=True)[0])
    assert apart(path, flight) <= 1e-3
    np.testing.assert_allclose(np.array(path)[:, 17:], flight[:, 17:], atol=1e-12)
    assert np.linalg.norm(flight[-1, :3] - flight[-1, 17:20]) < (0.1 if name == "itm-robust" else 2)


@node
@pytest.mark.parametrize("loops", [False, True])
def test_a_drawn_path_becomes_smooth_and_keeps_its_limits(loops, tmp_path):
    """A zigzag that a hand draws, or a rectangle: corners are rounded and taken slowly."""
    corners = [[3, 0], [3, 4], [-3, 4], [-3, -2]]
    if loops:
        corners += [[3, -2], [3, -0.2]]
    drawn = [[x, y, 10.0] for x, y in corners]
    start = {"position": [0, 0, 10], "quaternion": [1, 0, 0, 0], "target": [0, 0, 10]}
    start |= {"velocity": [0, 0, 0], "body_rates": [0, 0, 0]}
    limits = {"speed": 2.5, "acceleration": 4.0, "dt": 0.01}
    vehicle = load_vehicle("itm").model_dump(mode="json")
    job = {"vehicle": vehicle, "start": start, "drawn": drawn, "limits": limits, "steps": 4000}
    rows = np.array(in_node(tmp_path, **job))
    position, velocity, acceleration = rows[:, :3], rows[:, 3:6], rows[:, 6:9]
    np.testing.assert_allclose(position[0], [0, 0, 10], atol=1e-9)
    np.testing.assert_allclose(velocity[0], 0, atol=1e-9)
    assert 2.0 < np.linalg.norm(velocity, axis=1).max() <= 2.5 * 1.01
    assert 2.0 < np.linalg.norm(acceleration, axis=1).max() <= 4.0 * 1.05
    # What follows is the derivative of what is before it, also where it loops.
    np.testing.assert_allclose(np.gradient(position, 0.01, axis=0)[2:-2], velocity[2:-2], atol=0.05)
    jerk = np.diff(acceleration, axis=0) / 0.01
    assert np.abs(jerk).max() < 60.0
    for x, y in corners:
        assert np.linalg.norm(position[:, :2] - [x, y], axis=1).min() < 0.5
    at_rest = np.linalg.norm(velocity[-1]) < 1e-9
    assert at_rest != loops
    if not loops:
        np.testing.assert_allclose(position[-1], drawn[-1], atol=1e-6)


KINDS = {
    "ppo": (PPO, {}),
    "relu": (PPO, {"policy_kwargs": {"net_arch": [33, 16, 8], "activation_fn": torch.nn.ReLU}}),
    "squashed": (A2C, {"use_sde": True, "policy_kwargs": {"squash_output": True}}),
    "sac": (SAC, {"policy_kwargs": {"net_arch": [32, 32]}}),
    "td3": (TD3, {"policy_kwargs": {"net_arch": [32, 32]}}),
}


NAMES = """
const { vehicles, added } = JSON.parse((await import("node:fs")).readFileSync(0, "utf8"));
console.log(JSON.stringify(added.map((vehicle) => addVehicle(vehicles, vehicle))));
"""


def test_a_vehicle_of_a_name_that_is_taken_gets_another(tmp_path):
    heavy = load_vehicle("itm").model_copy(update={"mass": 2.0})
    model = PPO.load(pretrained_path("itm-recovery"), device="cpu")
    FlightSettings(vehicle=heavy).write_into(model)
    model.save(tmp_path / "heavy.zip")
    page, first, _ = make_page(
        parse_controllers([f"{label}={tmp_path}/heavy.zip" for label in ("one", "two")])
    )
    data = json.loads(page.split('id="data">')[1].split("</script>")[0])
    assert {agent["vehicle"] for agent in data["agents"]} == {first.name} == {"itm′"}
    if NODE is not None:
        vehicles = [load_vehicle("itm").model_dump(mode="json")]
        added = [*vehicles, *2 * [heavy.model_dump(mode="json")]]
        names = in_node(tmp_path, NAMES, vehicles=vehicles, added=added)
        assert names == ["itm", "itm′", "itm′"]


LIMITS = """
const job = JSON.parse((await import("node:fs")).readFileSync(0, "utf8"));
const fleet = new Fleet([], [], job.vehicle);
fleet.start = job.start;
const limits = job.worlds.map((world) => {
  fleet.set({ mass: 1, delay: fleet.vehicle.delay, gusts: 0, noise: 0, ...world });
  return physicalLimit(fleet);
});
console.log(JSON.stringify(limits));
"""


@node
def test_the_physical_limit_is_that_of_the_vehicle_that_flies(tmp_path):
    vehicle = load_vehicle("itm")
    home = {"position": [0, 0, 15], "quaternion": [1, 0, 0, 0], "target": [10, 0, 15]}
    start = {**home, "velocity": [0, 0, 0], "body_rates": [0, 0, 0]}
    worlds = [{}, {"mass": 0.6}, {"delay": vehicle.delay + 1}, {"gusts": 0.1}, {"noise": 0.1}]
    job = {"vehicle": vehicle.model_dump(mode="json"), "start": start, "worlds": worlds}
    limit = vehicle.time_optimal[10.0]
    harness = script(["fleet"]) + LIMITS
    assert in_node(tmp_path, harness, **job) == [limit, None, None, None, limit]


@node
@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_page_reads_zips_of_any_algorithm(kind, tmp_path):
    algorithm, keywords = KINDS[kind]
    model = algorithm("MlpPolicy", Env(), device="cpu", seed=0, **keywords)
    model.save(tmp_path / "agent.zip")
    observations = np.random.default_rng(0).standard_normal((5, 18)).astype(np.float32) * 3
    found = in_node(
        tmp_path, zip=str(tmp_path / "agent.zip"), observations=observations.astype(float).tolist()
    )
    expected = model.predict(observations, deterministic=True)[0]
    np.testing.assert_allclose(np.clip(found, -1, 1), expected, atol=1e-5)


@node
@pytest.mark.slow
def test_a_zip_that_does_not_fit_is_refused_in_one_line(tmp_path):
    import gymnasium

    content = pretrained_path("itm-recovery").read_bytes()
    PPO("MlpPolicy", gymnasium.make("Pendulum-v1"), device="cpu").save(tmp_path / "pendulum.zip")
    (tmp_path / "text.zip").write_text("no zip")
    rebuild = b"torch._utils\n_rebuild_tensor_v2"
    (tmp_path / "pickled.zip").write_bytes(content.replace(rebuild, rebuild[:-1] + b"9"))
    expected = {
        "pendulum": "network takes 3 numbers and gives 1",
        "text": "this is no zip",
        "pickled": "torch._utils _rebuild_tensor_v9, which this page does not read",
    }
    for name, message in expected.items():
        assert message in in_node(tmp_path, zip=str(tmp_path / f"{name}.zip"))


@pytest.mark.parametrize("given", ["privileged_geometric", "examples.hover:Hover", "nothere.zip"])
def test_a_controller_that_the_page_cannot_fly_is_named(given, tmp_path, capsys):
    assert main(["demo", given, "-o", str(tmp_path / "demo.html")]) == 2
    said = capsys.readouterr().err
    assert given in said and said.count("\n") == 1 and not (tmp_path / "demo.html").exists()


def test_a_page_is_one_file_that_needs_no_other(tmp_path, capsys):
    file = tmp_path / "demo.html"
    assert (
        main(
            [
                "demo",
                "two <!--<script> PIDs=pid",
                "geometric",
                "--vehicle",
                "crazyflie",
                "-o",
                str(file),
            ]
        )
        == 0
    )
    text = file.read_text()
    assert not re.search(
        r"https?://|<link(?! rel=\"icon\" href=\"data:)|src=|@import|url\(|^import |^export ",
        text,
        re.M,
    )
    data = json.loads(text.split('id="data">')[1].split("</script>")[0])
    assert [agent["label"] for agent in data["agents"]] == [
        "two <!--<script> PIDs",
        "geometric",
    ] and data["vehicle"] == "crazyflie"
    assert main(["demo", "pid", "-o", str(file)]) == 2  # exists
    assert "--overwrite" in capsys.readouterr().err


LITERALS = """
export const text = `first
    indented
  // no comment
  import nothing;
${[1].map((k) => `a
   b ${k}`)} /** kept */
`;
export const other = "/** kept */"; // it's a `comment`
  // dropped
const last = '// kept';
"""


def test_strings_of_the_scripts_stay_as_they_are():
    """Literals with leading spaces, and with what looks like code or a comment."""
    text = join_modules(LITERALS)
    literal = LITERALS.split("`;")[0].partition("`")[2]
    assert f"const text = `{literal}`;" in text
    assert 'const other = "/** kept */"; // it\'s a `comment`\n' in text
    assert "dropped" not in text and "const last = '// kept';" in text
    assert not re.search(r"^export", text, re.M)


def test_a_feature_that_the_page_does_not_compute_is_refused(monkeypatch):
    (spec,) = parse_controllers(["itm-recovery"])
    monkeypatch.setattr(page_module, "FEATURES", {"position", "rotation", "velocity"})
    with pytest.raises(ConfigError, match=r"itm-recovery.*does not compute body_rates"):
        describe(spec)


@functools.cache
def default_page():
    return make_page(parse_controllers(DEFAULT_AGENTS))


def test_names_are_no_html():
    """Of a zip that somebody else has named, and whose network is large enough to be rounded."""
    name = "<img src=x onerror=alert(1)>"
    (spec,) = parse_controllers(["any-quadcopter"])
    page, _, rounded = make_page([dataclasses.replace(spec, label=name)])
    assert rounded == [name]
    assert "<img" not in page
    assert "Weights of &lt;img src=x onerror=alert(1)&gt; are rounded" in page


@pytest.mark.slow
def test_the_default_page_is_small():
    page, _, rounded = default_page()
    assert len(page.encode()) <= 660_000
    assert set(rounded) == {"any-quadcopter", "itm-robust"}
    assert f"Weights of {' and '.join(rounded)} are rounded" in page


@pytest.mark.slow
def test_the_scripts_keep_their_types(tmp_path):
    compiler = shutil.which("tsc")
    if compiler is None:
        pytest.skip("there is no tsc on this machine (npm install --global typescript)")
    from importlib.resources import files

    folder = files("sb3_quad.show.demo")
    done = subprocess.run(
        [compiler, "-p", str(folder / "jsconfig.json")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


_AT_3_AND_4 = """import fcntl, os, sys
high = [fcntl.fcntl(int(each), fcntl.F_DUPFD, 10) for each in sys.argv[1:3]]
for descriptor, each in zip((3, 4), high):
    os.dup2(each, descriptor)
os.execv(sys.argv[3], sys.argv[3:])
"""


class Browser:
    """Headless Chromium at the other end of two pipes (Chrome DevTools Protocol)."""

    def __init__(self, folder):
        ours, theirs = os.pipe(), os.pipe()
        arguments = (
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            f"--user-data-dir={folder}",
            "--remote-debugging-pipe",
        )
        command = (
            sys.executable,
            "-c",
            _AT_3_AND_4,
            str(ours[0]),
            str(theirs[1]),
            CHROMIUM,
            *arguments,
            "about:blank",
        )
        nowhere = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.process = subprocess.Popen(command, pass_fds=(ours[0], theirs[1]), **nowhere)
        os.close(ours[0])
        os.close(theirs[1])
        self.out, self.answers = os.fdopen(ours[1], "wb", 0), os.fdopen(theirs[0], "rb")
        self.count, self.session, self.errors, self.rest = 0, None, [], b""
        (page,) = [
            each for each in self.call("Target.getTargets")["targetInfos"] if each["type"] == "page"
        ]
        self.session = self.call("Target.attachToTarget", targetId=page["targetId"], flatten=True)[
            "sessionId"
        ]
        self.call("Runtime.enable")
        self.call("Log.enable")

    def call(self, method, **params):
        self.count += 1
        message = {"id": self.count, "method": method, "params": params}
        self.out.write(
            json.dumps(message | ({"sessionId": self.session} if self.session else {})).encode()
            + b"\0"
        )
        while True:
            while b"\0" not in self.rest:
                self.rest += self.answers.read1(1 << 16) or pytest.fail("chromium has ended")
            text, self.rest = self.rest.split(b"\0", 1)
            answer = json.loads(text)
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.errors.append(answer["params"])
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]

    def value(self, expression):
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, (answer, self.errors)
        return answer["result"].get("value")

    def wait_for(self, expression):
        """The first value of an expression that is true, within two minutes."""
        end = time.monotonic() + 120
        while time.monotonic() < end:
            if value := self.value(expression):
                return value
            time.sleep(0.05)
        pytest.fail(f"never true: {expression}; {self.errors}")

    def open(self, file, width, height):
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        self.call("Page.navigate", url=file.as_uri())
        self.wait_for("typeof demo === 'object' && demo.frames() > 2")

    def drag(self, start, end):
        """Press, move within 0.1 s by the events' own clock, and let go while moving."""
        now = time.time()
        for k, kind in enumerate(["mousePressed", *9 * ["mouseMoved"], "mouseReleased"]):
            x, y = (a + (b - a) * min(k, 9) / 9 for a, b in zip(start, end, strict=True))
            how = {"button": "left", "buttons": 1, "clickCount": 1, "timestamp": now + 0.01 * k}
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **how)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    found = Browser(tmp_path_factory.mktemp("browser"))
    yield found
    found.call("Browser.close")
    found.process.wait(30)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "demo.html"
    file.write_text(default_page()[0])
    return file


@chromium
@pytest.mark.slow
def test_a_throw_comes_back_and_a_push_disturbs(browser, page):
    browser.open(page, 1280, 800)
    assert browser.value("demo.fleet.flying.length") == 4
    browser.wait_for(
        "demo.fleet.flying.some((each) => each.flight.time > 0.5)"
    )  # it flies by itself
    rounds = browser.value("demo.fleet.rounds")
    place = "demo.camera.project(demo.player.bodies()[1].position).slice(0, 2)"
    x, y = browser.value(place)
    browser.drag((x, y), (x + 60, y - 90))
    assert (
        browser.value("demo.fleet.rounds") == rounds + 1
    )  # all begin anew, from where they were let go
    thrown = browser.value("demo.fleet.start")
    assert np.linalg.norm(thrown["velocity"]) > 0.5
    geometric = "demo.fleet.entries[1].flight"
    assert browser.value(f"{geometric}.distance") > 0.3
    browser.wait_for(f"{geometric}.arrival > 0 && {geometric}.distance < 0.05")
    browser.wait_for(
        "document.querySelector('#score tr:nth-child(2) td').textContent.includes(' of ')"
    )

    browser.value("document.getElementById('tool-push').click()")
    x, y = browser.value(place)
    browser.call(
        "Input.dispatchMouseEvent",
        type="mousePressed",
        x=x,
        y=y,
        button="left",
        buttons=1,
        clickCount=1,
    )
    browser.call(
        "Input.dispatchMouseEvent", type="mouseMoved", x=x + 150, y=y, button="left", buttons=1
    )
    browser.wait_for(f"{geometric}.distance > 0.2")
    browser.call(
        "Input.dispatchMouseEvent",
        type="mouseReleased",
        x=x + 150,
        y=y,
        button="left",
        clickCount=1,
    )
    browser.wait_for(f"{geometric}.distance < 0.05")

    assert browser.value("document.getElementById('limit').hidden")
    browser.value("demo.fleet.vehicle.time_optimal = { 10: 1.5 }")
    browser.value("demo.player.start('10 m away')")
    browser.wait_for("document.getElementById('limit').innerText.includes('1.50 s')")
    assert not browser.errors


@chromium
@pytest.mark.slow
def test_they_follow_what_is_drawn_and_a_throw_comes_back_to_it(browser, page):
    browser.open(page, 1280, 800)
    browser.value("document.getElementById('tool-draw').click()")
    assert browser.value("demo.camera.pitch") > 1.4 and not browser.value("demo.player.apart")
    browser.value("demo.player.start('10 m away')")
    browser.wait_for("demo.fleet.entries[1].flight.distance < 0.1")
    middle = browser.value("demo.camera.project(demo.fleet.target).slice(0, 2)")
    pixels = browser.value("demo.camera.pixels(demo.camera.distance)")
    turns = np.linspace(0.0, 2.0 * np.pi, 60)
    circle = np.stack([np.cos(turns) - 1, np.sin(turns)], axis=1) * 2.0 * pixels + middle
    for k, (x, y) in enumerate(circle):
        kind = "mouseMoved" if k else "mousePressed"
        how = {"button": "left", "buttons": 1, "clickCount": 1}
        browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **how)
    x, y = circle[-1]
    browser.call("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, button="left")
    assert browser.value("demo.fleet.path.course.loops")
    robust = "demo.fleet.entries[2].flight"
    browser.wait_for(f"demo.fleet.path.time > 10 && {robust}.distance < 0.15")
    browser.wait_for("document.getElementById('reference-speed').textContent === '2.0 m/s'")
    off = browser.value("document.querySelector('#score tr:nth-child(3) td:last-child').innerText")
    assert re.fullmatch(r"0\.\d{3}", off)

    browser.value("document.getElementById('tool-throw').click()")
    x, y = browser.value("demo.camera.project(demo.player.bodies()[2].position).slice(0, 2)")
    browser.drag((x, y), (x + 60, y - 40))
    browser.wait_for(f"demo.fleet.path && {robust}.time > 4 && {robust}.distance < 0.15")
    browser.value("dispatchEvent(new KeyboardEvent('keydown', { key: 'u' }))")
    assert browser.value("demo.fleet.path") is None
    browser.wait_for("document.getElementById('reference').hidden")
    assert not browser.errors


@chromium
@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(1280, 800), (390, 844)])
def test_everything_has_a_name_and_fits(browser, page, width, height):
    browser.open(page, width, height)
    assert browser.value("document.documentElement.scrollWidth") <= width
    nameless = """[...document.querySelectorAll("button, input, select, canvas")].filter((each) =>
        !(each.ariaLabel || each.textContent.trim() ||
          [...(each.labels ?? [])].some((label) => label.textContent.trim())))
        .map((each) => each.outerHTML)"""
    assert browser.value(nameless) == []
    browser.value("dispatchEvent(new KeyboardEvent('keydown', { key: 'r' }))")
    assert browser.value("document.querySelector('#start-random').ariaPressed") == "true"
    browser.value("dispatchEvent(new KeyboardEvent('keydown', { key: ' ' }))")
    frozen = browser.value("demo.fleet.entries[0].flight.time")
    frames = browser.value("demo.frames()")
    browser.wait_for(f"demo.frames() > {frames} + 5")
    assert browser.value("demo.fleet.entries[0].flight.time") == frozen
    assert not browser.errors


def moving(vehicle, rng):
    """A state in motion with all rotors turning, and speeds that are commanded."""
    state = np.zeros(STATE_SIZE)
    hover = math.sqrt(vehicle.mass * vehicle.gravity / 4 / vehicle.thrust_coefficient)
    attitude = rng.normal(size=4)
    state[X.position : X.position + 3] = rng.normal(size=3)
    state[X.quaternion : X.quaternion + 4] = attitude / np.linalg.norm(attitude)
    state[X.velocity : X.velocity + 3] = 3 * rng.normal(size=3)
    state[X.body_rates : X.body_rates + 3] = 8 * rng.normal(size=3)
    state[X.rotor_speeds : X.rotor_speeds + 4] = hover * rng.uniform(0.6, 1.4, 4)
    return state, hover * rng.uniform(0.6, 1.4, 4)


@node
@pytest.mark.parametrize("changes", [{}, BREEZY], ids=["itm", "breezy"])
def test_the_page_differentiates_its_physics(changes, tmp_path):
    vehicle = load_vehicle("itm").model_copy(update=changes)
    rng = np.random.default_rng(3)
    state, wanted = moving(vehicle, rng)
    inputs = np.concatenate([state[: X.rotor_speeds + 4], wanted])
    by_result = rng.normal(size=X.rotor_speeds + 4)
    job = {"vehicle": vehicle.model_dump(mode="json"), "seed": 0}

    def step(values):
        later = [*values[:-4], *state[values.size - 4 :]]
        ours, theirs = in_node(
            tmp_path, LEARNING, what="step", state=later, wanted=values[-4:].tolist(), **job
        )
        np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-13)
        return by_result @ np.array(ours[: X.rotor_speeds + 4])

    gradient = in_node(
        tmp_path,
        LEARNING,
        what="undo",
        state=state.tolist(),
        wanted=wanted.tolist(),
        by=by_result.tolist(),
        **job,
    )
    # The derivative along a direction, by central differences
    direction = rng.normal(size=inputs.size) * np.maximum(1.0, np.abs(inputs))
    change = 1e-6 * direction
    difference = (step(inputs + change) - step(inputs - change)) / 2e-6
    assert np.dot(gradient, direction) == pytest.approx(difference, rel=1e-6)


@node
@pytest.mark.slow
def test_a_network_trained_by_the_page_recovers(tmp_path):
    vehicle = load_vehicle("itm").model_dump(mode="json")
    numbers = in_node(tmp_path, LEARNING, what="learn", vehicle=vehicle, seed=0)
    env = QuadcopterVecEnv(1, task="state_recovery", n_threads=1)
    model = PPO("MlpPolicy", env, policy_kwargs={"net_arch": [64, 64]}, device="cpu")
    policy = model.policy
    layers = [policy.mlp_extractor.policy_net, policy.action_net]
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    torch.nn.utils.vector_to_parameters(torch.tensor(numbers), parameters)
    flights = fly_flights(model, "state_recovery", 240, seed=5, noise=0.05)
    assert flights.success.mean() > 0.9
