"""The scripts in examples/, run as a newcomer would run them, but for a short while."""

import importlib.util
import re
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image
from stable_baselines3 import PPO

from sb3_quad.agents.resolve import resolve_expert
from sb3_quad.cli import main
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation.frames import PositionIntegral
from sb3_quad.envs.simulation.state import X
from sb3_quad.envs.vehicles.vehicle import load_vehicle

EXAMPLES = Path(__file__).resolve().parent.parent / "examples"
SHORT = ("--timesteps", "100")  # a single rollout


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)

    def run_script(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run_script


def test_every_script_is_run_and_says_how_it_is_started():
    names = ("test_examples.py", "test_px4.py", "test_real_flights.py")
    tests = "".join((Path(__file__).parent / name).read_text("utf-8") for name in names)
    for path in EXAMPLES.glob("*.py"):
        assert (
            f'"{path.stem}' in tests
            or f"import {path.stem}" in tests
            or f"from {path.stem}" in tests
        )
        assert f"python examples/{path.name}" in path.read_text(encoding="utf-8")


def test_a_battery_leaves_less_of_the_largest_thrust(run):
    output = run("firmware.py", "volts")
    assert "brushless, at most 0.2 N a rotor" in output and "3.00 V: largest" in output


def shares(output):
    """By who flew, the percentages of success and survival that an example prints."""
    lines = re.findall(
        r"^(.+): (?:mean reward .+, )?success ([\d.]+)%, survival ([\d.]+)%$",
        output,
        flags=re.MULTILINE,
    )
    return {name: (float(success), float(survival)) for name, success, survival in lines}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "agents", "success"),
    [
        ("own_expert.py", ["agent"], 95.0),
        ("own_vehicle.py", ["agent"], 95.0),
        ("own_reward.py", ["agent after training"], 95.0),
        ("own_callback.py", ["agent"], 95.0),
        ("flight_metrics.py", ["agent"], 95.0),
        ("trajectory_plots.py", ["agent"], 95.0),
    ],
)
def test_agents_succeed(run, name, agents, success):
    """As the examples are shipped; 480 episodes of 15 s each, as they print. The thesis's stages:
    tests/test_docs.py.
    """
    output = run(name)
    found = shares(output)
    rewards = [float(reward) for reward in re.findall(r"mean reward (-[\d.]+)", output)]
    assert rewards == sorted(set(rewards)), "training by a reward of one's own raises it"
    for agent in agents:
        assert found[agent][0] >= success and found[agent][1] >= 97.0, found


def test_imitation_then_stage_two_then_stock_sb3(run, tmp_path):
    assert {"agent, state_recovery", "agent, target_tracking"} < shares(
        run("train_dagger.py", *SHORT)
    ).keys()
    output = run("train_ppo_bc.py", "dagger.zip", *SHORT)
    assert "tracking: success" in output and "saved to ppo_bc.zip" in output
    assert (tmp_path / "best_model.zip").is_file() and (
        tmp_path / "evaluations_tracking.npz"
    ).is_file()
    first, second = (
        PPO.load(name, device="cpu").policy.state_dict() for name in ("dagger.zip", "ppo_bc.zip")
    )
    # One rollout of stage two only warms up the critic: the actor is the one that was handed over.
    assert np.array_equal(first["action_net.weight"], second["action_net.weight"])
    assert not np.array_equal(first["value_net.weight"], second["value_net.weight"])
    assert "m from the target after 15 s" in run("load_in_plain_sb3.py", "ppo_bc.zip")


@pytest.mark.slow
def test_a_cloned_lqr_gets_better_by_a_reward_of_energy(run):
    output = run("energy_reward.py")
    rewards = dict(
        re.findall(r"^(\w+): mean reward (-[\d.]+), survival 100.0%$", output, re.MULTILINE)
    )
    assert float(rewards["PPOBC"]) > max(float(rewards["LQR"]), float(rewards["DAgger"])) + 0.3
    assert float(re.search(r"error ([\d.]+) m", output).group(1)) < 0.1


def mean_rewards(output):
    """By what flew, the mean rewards that an example on other environments prints."""
    lines = re.findall(r"^(.+): mean reward (-?[\d.]+), worst -?\d+$", output, re.MULTILINE)
    return {name: float(reward) for name, reward in lines}


@pytest.mark.slow
def test_a_pendulum_learns_from_its_expert_and_beyond_a_gentle_one(run):
    found = mean_rewards(run("pendulum.py"))
    assert found["DAgger"] > found["expert"] - 20.0
    assert found["PPOBC from there"] > found["gentle expert"] + 40.0
    assert found["PPOBC from there"] > max(found["DAgger from it"], found["PPO alone"]) + 40.0


def test_pendulum_runs_with_short_trainings(run, tmp_path):
    found = mean_rewards(run("pendulum.py", *SHORT, "--imitation-timesteps", "100"))
    assert [*found][:4] == ["expert", "DAgger", "gentle expert", "DAgger from it"]
    assert [*found][4:] == ["PPOBC from there", "PPO alone"]
    assert found["gentle expert"] < found["expert"]
    PPO.load(tmp_path / "pendulum_ppo_bc.zip", device="cpu")


def test_lunar_lander_runs_with_a_short_training(tmp_path, monkeypatch, capsys):
    """And its expert is the one that Gymnasium has for a single lander."""
    pytest.importorskip("Box2D")
    pytest.importorskip("pygame")
    from gymnasium.envs.box2d.lunar_lander import LunarLander, heuristic

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["lunar_lander.py", *SHORT])
    script = runpy.run_path(str(EXAMPLES / "lunar_lander.py"), run_name="__main__")
    assert [*mean_rewards(capsys.readouterr().out)] == ["expert", "DAgger"]
    observations = np.random.default_rng(0).normal(size=(20, 8)).astype(np.float32)
    observations[:, 6:] = 0.0
    observations[10:, 6] = 1.0  # a leg touches the ground
    expected = [heuristic(LunarLander(continuous=True), row) for row in observations]
    np.testing.assert_allclose(script["land"](observations), expected, rtol=1e-5, atol=1e-5)


def test_energy_reward_runs_with_short_trainings(run):
    output = run("energy_reward.py", *SHORT, "--imitation-timesteps", "100")
    assert re.findall(r"^(\w+): mean reward -", output, re.MULTILINE) == ["LQR", "DAgger", "PPOBC"]


@pytest.mark.parametrize("name", ["own_expert.py", "own_vehicle.py"])
def test_own_experts_and_vehicles_recover(run, name):
    output = run(name, *SHORT)
    found = shares(output)
    teacher = found["own expert" if name == "own_expert.py" else "geometric"]
    assert min(teacher) > 99.0 and teacher > found["PID"] and "agent" in found


@pytest.mark.slow
def test_a_nominal_policy_recovers_after_half_a_minute(run):
    last = run("nominal_policy.py", "--seed", "0").splitlines()[-1]
    assert float(re.search(r"([\d.]+)% of 3,840", last)[1]) > 98.5


@pytest.mark.slow
def test_learning_speed(run, tmp_path):
    method = "model's gradient from the clone"
    run("learning_speed.py", "rows.csv", "a.png", "--cpu-seconds", "1", "--methods", method)
    rows = (tmp_path / "rows.csv").read_text()
    assert "clone of the PID,0," in rows and f"{method},0," in rows
    run("learning_speed.py", "rows.csv", "b.png", "--draw")
    assert Image.open(tmp_path / "b.png").size[0] > 500


def test_cloning_plot(run, tmp_path):
    rows = [
        f'"our reward, {kind}",tracking,{error}'
        for kind, error in (("cloning", 0.1), ("none", 0.5), ("none", 0.6))
    ]
    (tmp_path / "results.csv").write_text("\n".join(["configuration,scenario,final_error", *rows]))
    run("cloning_plot.py", "results.csv", "cloning.png")
    assert Image.open(tmp_path / "cloning.png").size[0] > 500


def test_adaptive_scaling(run, tmp_path):
    """A PID that takes its target to lie 0.3 m off, as a policy: μ is what α, 0.5 at the target,
    leaves of that.
    """
    (tmp_path / "observing.py").write_text(
        "import numpy as np\n"
        "from sb3_quad import PIDExpert\n"
        "def make(vehicle):\n"
        "    mean = np.zeros(18); mean[0] = -0.3\n"
        "    expert = PIDExpert(vehicle)\n"
        "    expert.observation_mean = mean\n"
        "    return lambda observation: expert.predict(observation)[0]\n"
    )
    printed = run(
        "adaptive_scaling.py", "pid", "agent=observing:make", "--episodes", "2", "-o", "times.png"
    )
    found = [float(x) for x in re.search(r"agent: offset μ = \((.+)\) m", printed)[1].split(",")]
    assert found == pytest.approx((-0.15, 0.0, 0.0), abs=0.01)
    assert "agent (adaptive)" in printed and "pid (adaptive)" not in printed
    assert Image.open(tmp_path / "times.png").size[0] > 500


@pytest.mark.slow
def test_thesis_readings(run):
    assert run("thesis_readings.py").count("of 240 recoveries survive") == 6


def test_own_callback(run):
    output = run(
        "own_callback.py", "--timesteps", "100000"
    )  # the first episodes end in the third rollout
    assert "crashed" in output


def test_stop_on_signal(run):
    """More of it: tests/test_callbacks.py."""
    with pytest.raises(SystemExit) as left:
        run("stop_on_signal.py", *SHORT)
    assert left.value.code == 0


def test_flight_metrics(run):
    assert "rollout/collision_rate: " in run("flight_metrics.py", "--timesteps", "150000")


def test_trajectory_plots(run, tmp_path):
    assert "tb/" in run("trajectory_plots.py", *SHORT)
    assert list(tmp_path.glob("tb/*/events*"))


def test_observation_statistics(run, tmp_path):
    printed = run("observation_statistics.py", "--timesteps", "4000").splitlines()
    assert [line.split()[0] for line in printed] == [
        "group",
        "position",
        "rotation",
        "velocity",
        "body_rates",
    ]
    deviations = yaml.safe_load((tmp_path / "sigma.yaml").read_text())["observation_std"]
    assert len(deviations) == 18 and np.sqrt(np.mean(np.square(deviations[:3]))) == pytest.approx(
        5.7, rel=0.3
    )  # m


@pytest.mark.slow
def test_tune_expert(run, tmp_path):
    poor = load_vehicle("itm").geometric_gains
    poor = poor.model_copy(update={"position": 0.9 * poor.position, "measured": None})
    slow = load_vehicle("itm").model_copy(update={"geometric_gains": poor})
    (tmp_path / "slow.yaml").write_text(
        yaml.safe_dump(slow.model_dump(mode="json", exclude_none=True))
    )
    few = ["slow.yaml", "-o", "tuned.yaml", "--starts", "120", "--targets", "8", "--episodes", "16"]
    printed = [
        run("tune_expert.py", *few, "-n", number) for number in ("3", "20")
    ]  # 17 more, from the journal
    costs = [
        float(re.search(r"\d gains tried, least cost (-?[\d.]+); saved tuned.yaml", text)[1])
        for text in printed
    ]
    assert costs[1] <= costs[0]
    tuned = load_vehicle("tuned.yaml")
    assert tuned.geometric_gains.measured["recovery_episodes"] == 64
    assert tuned.model_copy(update={"geometric_gains": poor}) == slow


@pytest.mark.slow
def test_time_optimal(run):
    """The least time is below the expert's, and no less than that of a point that may accelerate in
    any direction at once.
    """
    pytest.importorskip("casadi")
    printed = run("time_optimal.py", "hummingbird", "--distances", "10", "--directions", "2")
    assert (
        1.0
        < float(re.search(r"hummingbird, 10 m: ([\d.]+) s .* 2 of 2 directions solved", printed)[1])
        < 1.6
    )


def test_publish(run, tmp_path):
    """More of it: tests/test_pretrained.py."""
    with pytest.raises(SystemExit) as left:
        run("publish.py", "itm-imitation", "--name", "mine", "--episodes", "1")
    assert left.value.code == 0 and {"mine.zip", "mine.md"} == {
        path.name for path in tmp_path.iterdir()
    }


def test_robustness_plot(run, tmp_path):
    asked = [
        "--suite",
        "robustness",
        "--scenario",
        "mass",
        "--episodes",
        "2",
        "-o",
        "results",
        "--no-report",
    ]
    assert main(["evaluate", "pid", *asked]) == 0
    run("robustness_plot.py", "results", "robustness.png")
    width, height = Image.open(tmp_path / "robustness.png").size
    assert width < height  # one scenario: one column of two panels


@pytest.mark.skipif(
    importlib.util.find_spec("foundation_policy") is None, reason="needs foundation-policy"
)
def test_raptor(run):
    output = run("raptor.py")
    assert output.count("survival") == 2


def test_a_batch_of_ones_own_learns(run):
    output = run("own_batch.py", "--timesteps", "60000")
    before, after = map(float, re.findall(r": ([\d.]+) of 200 steps upright", output))
    assert before < 100.0 < 150.0 < after


def test_a_gradient_of_ones_own_leads_to_the_mark(run):
    output = run("gradient_of_your_environment.py", "--updates", "40")
    before, after = map(float, re.findall(r"([\d.]+) m from the mark", output))
    assert after < 0.5 * before


def imported(name):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_an_agent_follows_a_stick():
    """Without a window, from a stick that a test moves: forward, turning, then at rest."""
    joystick = imported("joystick")  # "joystick.py"
    moves = [*400 * [(1.0, 0.0, 0.2, 0.5)], *400 * [(0.0, 0.0, 0.0, 0.0)]]
    asked, off, jumps = iter(moves), [], []
    for env, guide in joystick.fly("itm-robust", lambda: next(asked, None), render_mode=None):
        off.append(np.linalg.norm(env.true_state().position[0] - guide.position))
        jumps.append(np.linalg.norm(guide.acceleration))
    assert len(off) == 800 and max(off) < 0.5 and off[-1] < 0.1
    assert max(jumps) < 6.0 and abs(guide.heading - 0.75 * 4.0) < 0.3
    forward = env.true_state().rotation[0, :2, 0]
    # It has not been trained to turn.
    turned = np.arctan2(forward[1], forward[0]) - guide.heading
    assert abs(np.arcsin(np.sin(turned))) < np.radians(25.0)


def test_the_observation_in_plain_sb3_is_that_of_the_environment():
    """Along a figure eight with a heading that turns, of an agent with frames and a preview."""
    sees = {"history": [0, 2], "last_action": True, "preview": [0, 5]}
    sees["position_integral"] = PositionIntegral().model_dump()
    curve = {"curve": "figure_eight", "speed": 1.0, "heading": 0.3, "heading_rate": 0.5}
    env = QuadcopterVecEnv(
        1, task_kwargs={"target_distance": 0.5}, noise=0.0, reference=curve, **sees
    )
    settings = {**sees, "vehicle": load_vehicle("itm").model_dump(mode="json")}
    observation = imported("load_in_plain_sb3").Observation(settings)
    expert = resolve_expert("geometric", load_vehicle("itm"))
    table = env.batch.tracks
    seen = env.reset()[0]
    action = np.zeros(4)
    for step in range(60):
        state = env.true_state()
        ours = observation(
            (state.position - state.target)[0],
            state.rotation[0],
            (state.velocity - state.target_velocity)[0],
            state.body_rates[0],
            action,
            heading=np.arctan2(*state.target_heading[0, ::-1]),
            heading_rate=state.array[X.target_heading_rate, 0],
            accelerations=table[[step, step + 5], 6:9],
        )
        np.testing.assert_allclose(ours, seen, atol=1e-5, err_msg=f"step {step}")
        action = expert.actions(state)[0]
        seen = env.step(action[None])[0][0]
