"""The expert that docs/experts.md writes, as it stands there."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_quad.evaluation.flights import fly
from sb3_quad.experts.resolve import resolve_expert

DOCUMENT = Path(__file__).resolve().parent.parent / "docs" / "experts.md"


@pytest.fixture
def module_folder(tmp_path, monkeypatch):
    blocks = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), flags=re.DOTALL)
    (code,) = (block for block in blocks if "def lqr(" in block)
    (tmp_path / "my_experts.py").write_text(code)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("my_experts", None)


def test_the_worked_example_flies_to_targets(module_folder):
    expert = resolve_expert("my_experts:lqr", "itm")
    flights = fly(expert, "target_tracking", 96, 5)
    assert flights.success.all() and np.isfinite(flights.time_to[0.1]).all()
    assert flights.final_error.max() < 0.02
    noisy = fly(lambda observation: expert.predict(observation)[0], "target_tracking", 16, 5)
    assert noisy.success.all()
