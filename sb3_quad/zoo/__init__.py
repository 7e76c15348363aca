"""Bridge to rl_zoo3: importing this makes our algorithms, settings files and batched environment known to it.

``python -m sb3_quad.zoo train …`` is ``rl_zoo3 train …`` with this import before it, and takes ``--algo dagger`` and
``--algo ppo_bc``; in a program, ``import sb3_quad.zoo`` comes before what it imports of rl_zoo3. The plain command imports a
module ``custom_envs`` if there is one: a file ``custom_envs.py`` that holds ``import sb3_quad.zoo``, in a folder on
``PYTHONPATH``, is enough.

Never imported by the rest of this package: rl_zoo3 replaces Gymnasium's ``TimeLimit`` when it is imported.

:raises MissingExtra: rl_zoo3 is not installed (the extra ``zoo``).
"""

from sb3_quad.base.imports import require

require("rl_zoo3", "zoo", "sb3_quad.zoo")

from sb3_quad.zoo.registration import register  # noqa: E402

register()
