"""Sweeps on Ray: the runs of a two-node cluster are those of this machine, also when a node is
lost; run by make test-zoo.
"""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sb3_quad.base.errors import ConfigError
from sb3_quad.cli import main
from sb3_quad.sweep.folder import read_results

pytest.importorskip("ray")

import ray
from ray.cluster_utils import Cluster

from sb3_quad.executors import start_executor

NET = {
    "n_steps": 20,
    "batch_size": 80,
    "gradient_steps": 2,
    "n_epochs": 1,
    "policy_kwargs": {"net_arch": [4]},
}
TINY = {
    "algo": "dagger",
    "env": "QuadStateRecovery-v0",
    "n_envs": 4,
    "eval_episodes": 0,
    "hyperparams": NET,
}
ROOT = Path(__file__).resolve().parent.parent


def write(path, **keys):
    path.write_text(json.dumps({**TINY, "n_timesteps": 160, "evaluation": {"episodes": 4}, **keys}))
    return str(path)


@pytest.fixture
def cluster(monkeypatch):
    monkeypatch.setenv("RAY_worker_niceness", "0")
    settings = {
        "health_check_initial_delay_ms": 0,
        "health_check_period_ms": 1000,
        "health_check_failure_threshold": 3,
    }
    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "_system_config": settings})
    made.add_node(num_cpus=1)
    yield made
    ray.shutdown()
    made.shutdown()


def flights(folder):
    """What the agents of a sweep flew, by the names of their runs."""
    return {name: result.flights for name, result in read_results(Path(folder)).items()}


def test_an_address_that_nobody_answers_is_refused_in_one_line():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    for address, words in (
        (f"127.0.0.1:{port}", "cannot be used; an address is auto, host:port or"),
        ("ray://host:port", "ValueError: invalid literal"),
    ):
        with pytest.raises(ConfigError, match=words):
            start_executor("ray", 1, address)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_cluster_that_loses_a_node_gives_the_table_of_one_machine(tmp_path, monkeypatch, cluster):
    monkeypatch.chdir(tmp_path)
    file = write(tmp_path / "s.yaml", seed=[0, 1, 2])
    command = [
        sys.executable,
        "-m",
        "sb3_quad.cli",
        "sweep",
        file,
        "--executor",
        "ray",
        "--address",
        cluster.address,
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([*command, "--no-progress"], cwd=tmp_path, env=environment)
    folder, end = tmp_path / "logs/sweep/s_1", time.monotonic() + 600
    while not list(folder.glob("records/*/*.json")) and process.poll() is None:
        assert time.monotonic() < end
        time.sleep(0.2)
    cluster.remove_node(next(iter(cluster.worker_nodes)), allow_graceful=False)
    assert process.wait(600) == 0
    assert main(["sweep", file, "--workers", "2", "--no-progress"]) == 0
    assert (
        flights("logs/sweep/s_1") == flights("logs/sweep/s_2")
        and len(flights("logs/sweep/s_1")) == 3
    )
    results = [Path(f"logs/sweep/s_{k}/results.json").read_text() for k in (1, 2)]
    assert results[0] == results[1]
