"""Vehicles of a distribution as records, for what compiled code samples."""

from typing import Any

from sb3_quad.base.validate import validate
from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import P
from sb3_quad.envs.simulation.vehicle_distribution import VehicleDistribution
from sb3_quad.envs.vehicles.vehicle import Vehicle, load_vehicle


def sample_vehicles(
    vehicles: Any, n: int, seed: int = 0, vehicle: str | Vehicle = "itm"
) -> list[Vehicle]:
    """Return n vehicles of a distribution, such as ``sample_vehicles("raptor", 1000)``.

    :param vehicles: a name, a path, a
        :class:`~sb3_quad.envs.simulation.vehicle_distribution.VehicleDistribution` or its fields.
    :param seed: vehicle i is that of the first episode of row i in environments of this seed.
    :param vehicle: the base vehicle, for what the distribution does not set.
    :raises ConfigError: an unknown name or field, or a value that does not fit; or some of them
        could not fly.
    """
    base = load_vehicle(vehicle)
    distribution = validate(VehicleDistribution, vehicles, "vehicles")
    batch = QuadcopterBatch(n, FlightSettings(vehicles=distribution, vehicle=base), seed)
    batch.reset()
    sampled = []
    for number, column in enumerate(batch.vehicles.T):
        # The parameters of this vehicle, by their names
        p = P._make(column)
        roll, pitch = column[P.roll_arm_0 : P.yaw_arm_0].reshape(2, 4)
        changes = {
            "name": f"sampled_{seed}_{number}",
            "mass": p.mass,
            "inertia": (p.ixx, p.iyy, p.izz),
            # The roll arms are y of the rotors, the pitch arms -x.
            "rotor_positions": tuple(zip(-pitch, roll, strict=True)),
            "moment_thrust_ratio": abs(p.yaw_arm_0),
            # If it is unknown, it stays 0.
            "thrust_coefficient": p.thrust_coefficient * bool(base.thrust_coefficient),
            "motor_gain_up": p.motor_gain_up,
            "motor_gain_down": p.motor_gain_down,
            "motor_integration": "exact",
            "drag": (p.drag_x, p.drag_y, p.drag_z),
            "rotor_drag": (p.rotor_drag_x, p.rotor_drag_y, p.rotor_drag_z),
            "translational_lift": p.translational_lift,
            "airspeed_moment": (p.airspeed_moment_roll, p.airspeed_moment_pitch),
            "rate_damping": (p.rate_damping_x, p.rate_damping_y, p.rate_damping_z),
            "rotor_inertia": p.rotor_inertia,
            "ground_effect_radius": p.ground_effect_radius,
            "rotor_thrust_limits": (
                p.thrust_middle - p.thrust_half_range,
                p.thrust_middle + p.thrust_half_range,
            ),
            "collision_radius": p.collision_radius,
            "rates": {"lag": p.rate_lag},
        }
        sampled.append(base.model_copy(update=changes))
    return sampled
