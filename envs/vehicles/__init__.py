"""Vehicles: one YAML file each, and what their parameters say they can do."""

from sb3_quad.envs.vehicles.vehicle import Vehicle, load_vehicle

__all__ = ["Vehicle", "load_vehicle"]
