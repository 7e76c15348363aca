"""Leaving a training when someone asks for it."""

from __future__ import annotations

from collections.abc import Callable

from stable_baselines3.common.callbacks import BaseCallback


class StopWhen(BaseCallback):
    """Ends the training after the first step at which ``asked()`` is true; nothing is interrupted half-way.

    :param asked: such as ``lambda: signals.received is not None``.
    """

    def __init__(self, asked: Callable[[], bool], verbose: int = 0) -> None:
        super().__init__(verbose)
        self._asked = asked

    def _on_step(self) -> bool:
        return not self._asked()
