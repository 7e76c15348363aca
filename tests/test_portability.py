"""Windows has no fcntl, no SIGHUP and no fork: without them the package is imported, flies, trains
and resumes.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from sb3_quad.base.compiled import _CacheFile
from sb3_quad.base.errors import ConfigError
from sb3_quad.base.files import LOCK, locked

ROOT = Path(__file__).resolve().parent.parent
WITHOUT_POSIX = """
import os, signal, sys
sys.modules["fcntl"] = sys.modules["resource"] = sys.modules["pwd"] = None
for module, name in [
    (signal, "SIGHUP"), (signal, "SIGKILL"), (os, "fork"),
    (os, "sched_getaffinity"),
]:
    if hasattr(module, name):
        delattr(module, name)
"""
SETTINGS = "n_timesteps: 200, n_envs: 4, n_steps: 25, batch_size: 50, gradient_steps: 2"
TRAIN = f"""
from pathlib import Path
from sb3_quad.base.files import locked
from sb3_quad.cli import main

Path("tiny.yml").write_text("QuadTargetTracking-v0: {{{SETTINGS}}}")
command = ["train", "--algo", "dagger", "--conf-file", "tiny.yml", "--eval-episodes", "0"]
assert main([*command, "--no-progress"]) == 0
run = Path("logs/dagger/QuadTargetTracking-v0_1")
assert main(["train", "--resume", str(run)]) == 2  # it is complete
with locked(run, "run folder"):
    assert main(["train", "--resume", str(run)]) == 2
evaluate = "evaluate pid geometric --suite quick -n 2 --scenario recovery --no-report"
assert main(evaluate.split()) == 0
"""


@pytest.mark.slow
def test_nothing_needs_posix(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_POSIX + f"sys.path.insert(0, {str(ROOT)!r})\n" + TRAIN],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


HOLD = """
import sys, time
from pathlib import Path
from sb3_quad.base.files import locked
with locked(Path(sys.argv[1]), "run folder"):
    print("locked", flush=True)
    time.sleep(100)
"""


def test_a_lock_refuses_a_second_process_and_ends_with_the_first(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout.readline() == "locked\n"
        with pytest.raises(ConfigError) as caught, locked(tmp_path, "run folder"):
            pass
        assert str(tmp_path) in str(caught.value)
    finally:
        process.kill()
        process.wait()
    (tmp_path / ".half.tmp").touch()
    with locked(tmp_path, "run folder"):
        assert [path.name for path in tmp_path.iterdir()] == [LOCK]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("share", [0.0, 0.5])
def test_compiled_code_that_a_crash_left_broken_counts_as_missing(tmp_path, suffix, share):
    cache = _CacheFile(str(tmp_path), "kernel", "stamp of the sources")
    for _ in range(2):
        cache.save("key", ("compiled", "code"))
        assert cache.load("key") == ("compiled", "code")
        (path,) = tmp_path.glob(f"*.{suffix}")
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])
        assert cache.load("key") is None
