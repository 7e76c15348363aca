"""The name in version 0.1 of :mod:`sb3_quad.vehicles.vehicle`."""

from sb3_quad.vehicles.vehicle import VEHICLES, Vehicle, load_vehicle

vehicle_names = VEHICLES.names

__all__ = ["Vehicle", "load_vehicle", "vehicle_names"]
