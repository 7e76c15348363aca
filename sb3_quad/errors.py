"""The name in version 0.1 of :mod:`sb3_quad.base.errors`."""

from sb3_quad.base.errors import *  # noqa: F403
