"""A sample of the bad inputs that ``inputs.py`` makes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

INPUTS = Path(__file__).with_name("inputs.py")
COUNT = os.environ.get("SB3_QUAD_INPUTS", "60")


@pytest.mark.slow
@pytest.mark.timeout(7200 if COUNT == "all" else 120 + 60 * int(COUNT))
def test_no_option_and_no_key_takes_a_bad_value_badly(tmp_path):
    """SB3_QUAD_INPUTS=all tries all."""
    root = INPUTS.parents[2]
    variables = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(INPUTS), str(tmp_path), COUNT]
    result = subprocess.run(command, capture_output=True, text=True, check=False, env=variables, cwd=root)
    assert result.returncode == 0, result.stdout + result.stderr
