"""Sweeps on Ray: a sweep that is killed on a cluster of two nodes, and restored, ends with the
table of one that nothing disturbs; run by make test-zoo.
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

ROOT = Path(__file__).resolve().parent.parent
SWEEP = {
    **TINY,
    "n_timesteps": 400,
    "hyperparams": {**NET, "callback": "test_ray.NotesNode"},
    "grid": {"env_kwargs.noise": [0.0, 0.05]},
    "seed": [0, 1],
    "evaluation": {"episodes": 4, "scenario": ["recovery", "tracking"]},
}


class NotesNode(BaseCallback):
    """Leaves a file with the name of the node, and takes time while there is a file ``slow``."""

    def _on_training_start(self):
        Path(f"{ray.get_runtime_context().get_node_id()}.node").touch()

    def _on_rollout_start(self):
        time.sleep(2.0 * Path("slow").exists())

    def _on_step(self):
        return True


@pytest.fixture
def cluster(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "tests"))
    # A busy machine starts Ray slowly.
    monkeypatch.setenv("RAY_raylet_start_wait_time_s", "300")
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    made.add_node(num_cpus=1)
    yield made
    ray.shutdown()
    made.shutdown()


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_killed_sweep_on_two_nodes_is_restored_with_the_same_table(
    tmp_path, monkeypatch, cluster
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.yaml").write_text(json.dumps(SWEEP))
    Path("slow").touch()
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}:{ROOT}/tests")
    command = [sys.executable, "-m", "sb3_quad.cli", "sweep", "--address", cluster.address]
    driver = subprocess.Popen([*command, "s.yaml"])
    end = time.monotonic() + 600
    while len([*tmp_path.glob("*.node")]) < 2 and driver.poll() is None:
        assert time.monotonic() < end
        time.sleep(0.2)
    driver.send_signal(signal.SIGKILL)
    assert driver.wait() == -signal.SIGKILL
    Path("slow").unlink()
    assert len([*tmp_path.glob("*.node")]) == 2
    subprocess.run([*command, "--resume", "logs/sweep/s_1", "--trust"], check=True)
    subprocess.run([*command, "s.yaml"], check=True)
    restored, whole = (Path(f"logs/sweep/s_{k}/results.csv").read_text() for k in (1, 2))
    assert restored == whole and len(whole.splitlines()) == 1 + 4 * 2
