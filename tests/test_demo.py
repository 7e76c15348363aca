"""The page of ``sb3-quad demo``: its model flies what Python flies, it reads zips, and in a browser
it can be thrown.
"""

import json
import math
import re
import shutil
import subprocess

import numpy as np
import pytest
import torch
from stable_baselines3 import A2C, PPO, SAC, TD3

from sb3_quad.agents.agent_settings import env_kwargs
from sb3_quad.agents.pretrained import pretrained_path
from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.cli import main
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation.state import STATE_SIZE, X
from sb3_quad.envs.vehicles.layout import NamedLayout
from sb3_quad.envs.vehicles.vehicle import VEHICLES, load_vehicle
from sb3_quad.evaluation.controllers import parse_controllers
from sb3_quad.evaluation.flights import fly as fly_flights
from sb3_quad.show.demo import page as page_module
from sb3_quad.show.demo.page import (
    DEFAULT_AGENTS,
    MODEL,
    describe,
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


def in_node(tmp_path, harness=HARNESS, seconds=60, **job):
    """What the page's model answers, without a browser."""
    file = tmp_path / "model.mjs"
    file.write_text(script(MODEL) + harness)
    command = [NODE, str(file)]
    how = {"input": json.dumps(job), "capture_output": True, "text": True}
    # Node 20 was once seen to hang before it answered: then it is started again.
    try:
        done = subprocess.run(command, timeout=seconds, check=False, **how)
    except subprocess.TimeoutExpired:
        done = subprocess.run(command, check=False, **how)
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
AIRY = {
    **BREEZY,
    "rotor_drag": (1e-4, 2e-4, 3e-5),
    "translational_lift": 0.02,
    "airspeed_moment": (2e-5, -1e-5),
    "rate_damping": (0.02, 0.03, 0.05),
    "rotor_inertia": 1e-4,
    "ground_effect_radius": 3.0,
    "thrust_factors": (0.95, 1.0, 1.05, 1.02),
}
WORLD = {"mass": 1.2, "motor_gain": 0.7, "thrust": 0.9}
BATTERY = NamedLayout(rotor_order="px4", arm_length=0.24, center_of_mass=(-0.03, 0.01)).rotors()


def vehicle_called(name):
    """A shipped vehicle, or ITM in wind, in another world, with another battery or motors."""
    if name in VEHICLES.names():
        return load_vehicle(name)
    changes = {
        "airy": AIRY,
        "battery": {**BATTERY, "thrust_coefficient": 0.0},
        "quick motors": {"motor_gain_up": 100.0, "motor_gain_down": 100.0},
    }.get(name, {})
    return load_vehicle("itm").model_copy(update=changes)


@node
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "action"),
    [
        ("crazyflie", "thrusts"),
        ("airy", "thrusts"),
        ("other world", "thrusts"),
        ("battery", "thrusts"),
        ("other world", "rates"),
        ("battery", "rates"),
        ("quick motors", "rates"),
    ],
)
def test_given_actions_lead_to_where_python_flies(name, action, tmp_path):
    vehicle = vehicle_called(name)
    task = {"start_position": (0.0, 0.0, 5000.0), "max_distance": 1e6}
    random = (
        {key: [value, value] for key, value in {**WORLD, "delay": 3}.items()}
        if name == "other world"
        else None
    )
    keywords = {"vehicle": vehicle, "action": action}
    env = Env(task="recovery_and_tracking", task_kwargs=task, randomize=random, **keywords)
    wrench = {"force": [0.2, -0.1, 0.3], "torque": [1e-4, -2e-4, 1e-4], "wind": [3.0, -2.0, 0.5]}
    env.set_wrench(wrench["force"], wrench["torque"])
    env.set_wind(wrench["wind"])
    walk = np.cumsum(0.03 * np.random.default_rng(0).standard_normal((STEPS, 4)), axis=0)
    hover = vehicle.hover_action * ([1, 0, 0, 0] if action == "rates" else 1)
    actions = np.clip(hover + walk, -1, 1).astype(np.float32)
    world = {"mass": 1.2, "motors": 0.7, "thrust": 0.9, "delay": 3} if random else None
    job = {
        "vehicle": vehicle.model_dump(mode="json"),
        "start": start_of(env),
        "wrench": wrench,
        "world": world,
    }
    if action == "rates":
        job["agent"] = {"label": "given", "kind": "network", "action": action}
    path = in_node(tmp_path, **job, steps=STEPS, actions=actions.astype(float).tolist())
    assert apart(path, fly(env, lambda _, step: actions[[step]])) <= 1e-9


@node
@pytest.mark.slow
@pytest.mark.parametrize("name", ["itm", "crazyflie", "battery"])
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


def reference_rows(env):
    """The reference of an environment's only row at each step, and somewhat beyond the flight."""
    table = env.batch.tracks.copy()
    table[:, :3] += env.true_state().target[0]
    return [table[k % len(table)].tolist() for k in range(STEPS + 40)]


EIGHT = {"curve": "figure_eight", "speed": 1.5, "heading": 0.3, "heading_rate": 0.4}


@node
@pytest.mark.slow
@pytest.mark.parametrize("how", ["described", "zip"])
@pytest.mark.parametrize(
    ("name", "vehicle", "reference"),
    [
        ("itm-recovery", "itm", None),
        ("itm-robust", "itm", EIGHT),
        ("any-quadcopter", "crazyflie", None),
    ],
)
def test_the_agents_fly_as_in_python(name, vehicle, reference, how, tmp_path, monkeypatch):
    """Exact weights, and those that the page reads from the zip itself."""
    monkeypatch.setattr(page_module, "EXACT", 10**6)
    (spec,) = parse_controllers([name])
    model = PPO.load(pretrained_path(name), device="cpu")
    changes = {"vehicle": vehicle, "vehicles": None, "noise": 0.0, "reference": reference}
    changes["task"] = "target_tracking" if reference else "state_recovery"
    env = Env(**{**env_kwargs(name), **changes})
    agent = {"agent": {"label": name, **describe(spec)}}
    source = {"zip": str(pretrained_path(name))} if how == "zip" else agent
    rows = {"rows": reference_rows(env)} if reference else {}
    flown = load_vehicle(vehicle).model_dump(mode="json")
    path = in_node(tmp_path, vehicle=flown, **source, **rows, start=start_of(env), steps=STEPS)
    flight = fly(env, lambda observation, _: model.predict(observation, deterministic=True)[0])
    assert apart(path, flight) <= 1e-3
    assert np.linalg.norm(flight[-1, :3] - flight[-1, 17:20]) < 0.2


KINDS = {
    "ppo": (PPO, {}),
    "relu": (PPO, {"policy_kwargs": {"net_arch": [33, 16, 8], "activation_fn": torch.nn.ReLU}}),
    "squashed": (A2C, {"use_sde": True, "policy_kwargs": {"squash_output": True}}),
    "sac": (SAC, {"policy_kwargs": {"net_arch": [32, 32]}}),
    "td3": (TD3, {"policy_kwargs": {"net_arch": [32, 32]}}),
}


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


@chromium
@pytest.mark.slow
def test_it_opens_in_a_browser(tmp_path):
    """After three seconds of its own time, every controller has a row in the table of scores."""
    page, *_ = make_page(parse_controllers(DEFAULT_AGENTS))
    file = tmp_path / "demo.html"
    file.write_text(page)
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    command += ["--virtual-time-budget=3000", f"--user-data-dir={tmp_path}", file.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    (scores,) = re.findall(r'<tbody id="score">(.*?)</tbody>', done.stdout, re.DOTALL)
    assert scores.count("<tr") == len(DEFAULT_AGENTS)


def moving(vehicle, rng):
    """A state in motion with all rotors turning, and speeds that are commanded."""
    state = np.zeros(STATE_SIZE)
    hover = math.sqrt(vehicle.mass * vehicle.gravity / 4 / vehicle.thrust_coefficient)
    attitude = rng.normal(size=4)
    state[X.position : X.position + 3] = 2.0 + rng.uniform(size=3)
    state[X.quaternion : X.quaternion + 4] = attitude / np.linalg.norm(attitude)
    state[X.velocity : X.velocity + 3] = 3 * rng.normal(size=3)
    state[X.body_rates : X.body_rates + 3] = 8 * rng.normal(size=3)
    state[X.rotor_speeds : X.rotor_speeds + 4] = hover * rng.uniform(0.6, 1.4, 4)
    return state, hover * rng.uniform(0.6, 1.4, 4)


@node
@pytest.mark.parametrize("changes", [{}, BREEZY, AIRY], ids=["itm", "breezy", "airy"])
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
@pytest.mark.campaign
@pytest.mark.timeout(900)
def test_a_network_trained_by_the_page_recovers(tmp_path):
    vehicle = load_vehicle("itm").model_dump(mode="json")
    numbers = in_node(tmp_path, LEARNING, 600, what="learn", vehicle=vehicle, seed=0)
    env = QuadcopterVecEnv(1, task="state_recovery", n_threads=1)
    model = PPO("MlpPolicy", env, policy_kwargs={"net_arch": [64, 64]}, device="cpu")
    policy = model.policy
    layers = [policy.mlp_extractor.policy_net, policy.action_net]
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    torch.nn.utils.vector_to_parameters(torch.tensor(numbers), parameters)
    flights = fly_flights(model, "state_recovery", 240, seed=5, noise=0.05)
    assert flights.success.mean() > 0.9
