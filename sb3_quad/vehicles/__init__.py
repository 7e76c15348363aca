"""One YAML file per vehicle; see :mod:`sb3_quad.vehicles.vehicle`."""
