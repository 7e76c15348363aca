"""Sweeps whose driver or node is killed at a random moment; each must end with all runs and the
table of the undisturbed one.

python tests/faults/sweep_campaign.py driver --sweeps 10 --folder campaign
python tests/faults/sweep_campaign.py node --sweeps 10 --folder campaign
python tests/faults/sweep_campaign.py speed --folder campaign

``node`` needs Ray, and starts two nodes on this machine. ``speed`` times 12 runs one by one, and
two at a time.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NET = {
    "n_steps": 100,
    "batch_size": 200,
    "gradient_steps": 20,
    "n_epochs": 1,
    "policy_kwargs": {"net_arch": [16]},
}
SWEEP = {
    "algo": "dagger",
    "env": "QuadStateRecovery-v0",
    "n_envs": 8,
    "eval_episodes": 0,
    "hyperparams": NET,
}
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": str(ROOT),
    "OMP_NUM_THREADS": "1",
    "RAY_worker_niceness": "0",
}


def start(folder: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """``sweep`` in a folder."""
    command = [sys.executable, "-m", "sb3_quad.cli", "sweep", *arguments, "--no-progress"]
    return subprocess.Popen(command, cwd=folder, env=ENVIRONMENT, stdout=subprocess.DEVNULL)


def timed(folder: Path, *arguments: str) -> float:
    """Seconds that a sweep takes that nothing disturbs."""
    begin = time.monotonic()
    if code := start(folder, *arguments).wait():
        sys.exit(f"an undisturbed sweep left with {code}")
    return time.monotonic() - begin


def table(folder: Path, number: int) -> str:
    """The results of a sweep."""
    return (folder / f"logs/sweep/sweep_{number}/results.json").read_text()


def main() -> None:
    """Run a campaign, and print a line for each sweep."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=("driver", "node", "speed"))
    parser.add_argument("--sweeps", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--timesteps", type=int, default=8000)
    parser.add_argument("--folder", type=Path, default=Path("campaign"))
    parser.add_argument("--executor", default="local")
    options = parser.parse_args()
    folder: Path = options.folder / options.kind
    folder.mkdir(parents=True)
    count = 12 if options.kind == "speed" else 6
    spec = {
        **SWEEP,
        "seed": list(range(count)),
        "n_timesteps": options.timesteps,
        "evaluation": {"episodes": 8},
    }
    (folder / "sweep.yaml").write_text(json.dumps(spec))
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    if options.kind == "speed":
        alone = timed(folder, "sweep.yaml", "--workers", "1")
        both = timed(folder, "sweep.yaml", "--workers", "2", "--executor", options.executor)
        (folder / "one.yaml").write_text(json.dumps({**spec, "seed": [0], "n_timesteps": 100}))
        begin = timed(folder, "one.yaml", "--workers", "1", "--executor", options.executor)
        print(
            f"one by one {alone:.1f} s, two at a time {both:.1f} s, start-up {begin:.1f} s; "
            f"load {os.getloadavg()[0]:.1f}"
        )
        return
    seconds = timed(folder, "sweep.yaml", "--workers", "2")
    whole = table(folder, 1)
    moments = random.Random(options.seed)
    kept = 0
    first = 2
    if options.kind == "node":
        seconds, on_nodes = node(folder, 2, None)
        if on_nodes != whole:
            sys.exit(
                "the undisturbed sweep on two nodes has another table than that on this machine"
            )
        first = 3
    for number in range(options.sweeps):
        moment = moments.uniform(0.1, 0.9) * seconds
        if options.kind == "driver":
            result = driver(folder, number + first, moment)
        else:
            _, result = node(folder, number + first, moment)
        kept += result == whole
        verdict = "the same table" if result == whole else "ANOTHER TABLE"
        print(f"sweep {number + 1}: killed after {moment:.1f} s: {verdict}", flush=True)
    print(
        f"{kept} of {options.sweeps} end with all runs and the same table; "
        f"load {os.getloadavg()[0]:.1f}"
    )


def driver(folder: Path, number: int, moment: float) -> str:
    """The table of a sweep whose driver is killed, then resumed."""
    process = start(folder, "sweep.yaml", "--workers", "2")
    place = folder / f"logs/sweep/sweep_{number}"
    end = time.monotonic() + moment
    while time.monotonic() < end or not (place / "plan.json").is_file():
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    start(folder, "--resume", str(place.relative_to(folder)), "--workers", "2").wait()
    return table(folder, number)


def node(folder: Path, number: int, moment: float | None) -> tuple[float, str]:
    """Seconds and table of a sweep on two nodes; one is killed, unless ``moment`` is None."""
    import ray
    from ray.cluster_utils import Cluster

    settings = {
        "health_check_initial_delay_ms": 0,
        "health_check_period_ms": 1000,
        "health_check_failure_threshold": 3,
    }
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 1, "_system_config": settings}
    )
    lost = cluster.add_node(num_cpus=1)
    try:
        begin = time.monotonic()
        process = start(folder, "sweep.yaml", "--executor", "ray", "--address", cluster.address)
        if moment is not None:
            time.sleep(moment)
            cluster.remove_node(lost, allow_graceful=False)
        process.wait()
        seconds = time.monotonic() - begin
    finally:
        ray.shutdown()
        cluster.shutdown()
    return seconds, table(folder, number)


if __name__ == "__main__":
    main()
