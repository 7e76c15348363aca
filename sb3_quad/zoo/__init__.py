"""Bridge to rl_zoo3: importing this makes our algorithms, settings files and batched environment known to it.

``python -m sb3_quad.zoo train …`` is ``rl_zoo3 train …`` with this import before it, and takes ``--algo dagger``,
``ppo_bc`` and ``sac_bc``. In a program, ``import sb3_quad.zoo`` comes before anything imported from rl_zoo3. The plain command
imports a module ``custom_envs`` if there is one: a file ``custom_envs.py`` that holds ``import sb3_quad.zoo``, in a folder
on ``PYTHONPATH``, is enough.

Never imported by the rest of this package: rl_zoo3 replaces Gymnasium's ``TimeLimit`` when it is imported.

:raises MissingExtra: rl_zoo3 is not installed (the extra ``zoo``).
"""

import importlib
import sys

from sb3_quad.base.imports import require

require("rl_zoo3", "zoo", "sb3_quad.zoo")

from rl_zoo3 import ALGOS  # noqa: E402

from sb3_quad.training.algorithms import ALGORITHMS, get_algorithm  # noqa: E402

for algo in ALGORITHMS:
    ALGOS.setdefault(algo, get_algorithm(algo))
# rl_zoo3's record_video imports exp_manager, which imports custom_envs, which may import this: too early for a subclass
# of what exp_manager is about to define, and none is needed there.
if hasattr(importlib.import_module("rl_zoo3.exp_manager"), "ExperimentManager"):
    from sb3_quad.zoo.manager import QuadExperimentManager

    for name, module in list(sys.modules.items()):
        if name.startswith("rl_zoo3.") and hasattr(module, "ExperimentManager"):
            module.ExperimentManager = QuadExperimentManager  # type: ignore[attr-defined]
