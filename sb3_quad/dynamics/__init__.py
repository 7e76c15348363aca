"""Names of version 0.1: see :mod:`sb3_quad.vehicles` and :mod:`sb3_quad.simulation`."""
