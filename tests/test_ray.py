"""Sweeps on Ray: a sweep that is killed on a cluster of two nodes, and restored, ends with the
table of runs that nothing disturbs; run by make test-zoo.
"""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from stable_baselines3.common.callbacks import BaseCallback

pytest.importorskip("ray.tune")

import ray
from ray.cluster_utils import Cluster
from test_sweep import NET, TINY

from sb3_quad.base import process
from sb3_quad.cli import main
from sb3_quad.training.sweep import checked_configurations, load_sweep, train_run
from sb3_quad.training.sweep_results import write_results

ROOT = Path(__file__).resolve().parent.parent
SEEDS = (0, 1, 2)
SWEEP = {
    **TINY,
    "n_timesteps": 400,
    "hyperparams": {**NET, "callback": "test_ray.NotesNode"},
    "seed": SEEDS,
    "evaluation": {"episodes": 4, "scenario": ["recovery", "tracking"]},
}


class NotesNode(BaseCallback):
    """Leaves a file with the name of the node, and takes time while there is a file ``slow``."""

    def _on_training_start(self):
        if ray.is_initialized():
            Path(f"{ray.get_runtime_context().get_node_id()}.node").touch()

    def _on_rollout_start(self):
        time.sleep(2.0 * Path("slow").exists())

    def _on_step(self):
        return True


@pytest.fixture
def cluster(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{ROOT}/tests")
    # Beside other tests, a worker with Ray's niceness of 15 would hardly run.
    monkeypatch.setenv("RAY_worker_niceness", "0")
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    made.add_node(num_cpus=1)
    yield made
    ray.shutdown()
    made.shutdown()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_killed_sweep_on_two_nodes_is_restored_with_the_table_of_its_runs(
    tmp_path, monkeypatch, cluster
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(process, "_most_cpus", process._most_cpus)
    Path("s.yaml").write_text(json.dumps(SWEEP))
    Path("slow").touch()
    command = ["sweep", "--address", cluster.address]
    driver = subprocess.Popen([sys.executable, "-m", "sb3_quad.cli", *command, "s.yaml"])
    end = time.monotonic() + 600
    while len([*tmp_path.glob("*.node")]) < 2 and driver.poll() is None:
        assert time.monotonic() < end
        time.sleep(0.2)
    driver.send_signal(signal.SIGKILL)
    assert driver.wait() == -signal.SIGKILL
    Path("slow").unlink()
    assert len([*tmp_path.glob("*.node")]) == 2
    assert main([*command, "--resume", "logs/sweep/s_1", "--trust"]) == 0
    sweep = load_sweep("s.yaml")
    alone = tmp_path / "alone"
    alone.mkdir()
    work = (alone, checked_configurations(sweep), sweep.evaluation.load(), str(tmp_path))
    choices = [{"configuration": "run", "seed": seed} for seed in SEEDS]
    flights = {tuple(each.values()): train_run(*work, each)["flights"] for each in choices}
    write_results(alone, flights)
    table = (alone / "results.csv").read_text()
    assert Path("logs/sweep/s_1/results.csv").read_text() == table
    assert len(table.splitlines()) == 1 + len(SEEDS) * 2
