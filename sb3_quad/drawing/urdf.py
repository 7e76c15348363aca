"""Robot descriptions (URDF) made from a vehicle's parameters: a single rigid body, and one rotor to look at."""

from __future__ import annotations

import math

import numpy as np

from sb3_quad.vehicles.vehicle import Vehicle

Colour = tuple[float, float, float, float]
Part = tuple[Colour, str]  # a visual element, and its colour

DARK: Colour = (0.13, 0.14, 0.17, 1.0)
GREY: Colour = (0.55, 0.58, 0.62, 1.0)
BLUE: Colour = (0.10, 0.36, 0.75, 1.0)
FRONT: Colour = (0.93, 0.32, 0.10, 1.0)
WHITE: Colour = (0.92, 0.93, 0.95, 1.0)


def arm_length(vehicle: Vehicle) -> float:
    """Distance of the outermost rotor from the centre of mass, m."""
    return max(math.hypot(x, y) for x, y in vehicle.rotor_positions)


def rotor_radius(vehicle: Vehicle) -> float:
    """Radius at which neighbouring rotors are drawn just clear of each other, m."""
    positions = np.asarray(vehicle.rotor_positions)
    distances = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    return 0.44 * float(distances[distances > 0].min())


def rotor_height(vehicle: Vehicle) -> float:
    """Height of the drawn rotors above the centre of mass, m."""
    return 0.17 * arm_length(vehicle)


def vehicle_urdf(vehicle: Vehicle) -> str:
    """The vehicle as one link: its inertia, its collision sphere, and a frame to look at (rotors are drawn apart).

    Everything is in one link because further links, even fixed ones, would make the physics another.
    """
    ixx, iyy, izz = vehicle.inertia
    return f"""<?xml version="1.0"?>
<robot name="{_escape(vehicle.name)}">
  <link name="base">
    <inertial>
      <origin xyz="0 0 0"/>
      <mass value="{vehicle.mass!r}"/>
      <inertia ixx="{ixx!r}" iyy="{iyy!r}" izz="{izz!r}" ixy="0" ixz="0" iyz="0"/>
    </inertial>
    <collision>
      <geometry><sphere radius="{vehicle.collision_radius!r}"/></geometry>
    </collision>
    {"".join(visual for _, visual in _frame(vehicle))}
  </link>
</robot>
"""


def frame_urdfs(vehicle: Vehicle) -> list[str]:
    """The frame to look at, a body without mass for each colour: PyBullet's window gives a link one colour only."""
    parts: dict[Colour, str] = {}
    for colour, visual in _frame(vehicle):
        parts[colour] = parts.get(colour, "") + visual
    return [_drawn("frame", visuals) for visuals in parts.values()]


def rotor_urdf(vehicle: Vehicle, rotor: int) -> str:
    """One rotor to look at: a hub and two blades in the plane z = 0, pitched to the sense it turns in; no mass."""
    radius = rotor_radius(vehicle)
    # A rotor's drag on the body is opposed to its sense of turning.
    pitch = 0.25 * -vehicle.rotor_directions[rotor]
    colour = FRONT if vehicle.rotor_positions[rotor][0] > 0 else WHITE
    blade = (0.94 * radius, 0.15 * radius, 0.02 * radius)
    parts = [_cylinder(0.09 * radius, 0.16 * radius, (0.0, 0.0, 0.0), colour)]
    for side, sign in ((0.5, 1.0), (-0.5, -1.0)):
        parts.append(_box(blade, (side * blade[0], 0.0, 0.0), (sign * pitch, 0.0, 0.0), colour))
    return _drawn(f"rotor_{rotor}", "".join(visual for _, visual in parts))


def _drawn(name: str, visuals: str) -> str:
    inertial = '<inertial><mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>'
    return f'<?xml version="1.0"?>\n<robot name="{name}"><link name="{name}">{inertial}{visuals}</link></robot>\n'


def _frame(vehicle: Vehicle) -> list[Part]:
    size, height = arm_length(vehicle), rotor_height(vehicle)
    parts = [
        _cylinder(0.30 * size, 0.10 * size, (0.0, 0.0, 0.02 * size), DARK),
        _cylinder(0.24 * size, 0.06 * size, (0.0, 0.0, 0.10 * size), BLUE),
        _box((0.34 * size, 0.20 * size, 0.12 * size), (-0.02 * size, 0.0, -0.10 * size), (0.0, 0.0, 0.0), GREY),
        _sphere(0.075 * size, (0.30 * size, 0.0, 0.04 * size), FRONT),  # the camera: this side is forward
    ]
    for x, y in vehicle.rotor_positions:
        length, angle = math.hypot(x, y), math.atan2(y, x)
        colour = FRONT if x > 0 else DARK
        parts.append(_box((length, 0.09 * size, 0.06 * size), (x / 2, y / 2, 0.02 * size), (0.0, 0.0, angle), colour))
        parts.append(_cylinder(0.09 * size, 0.9 * height, (x, y, 0.45 * height), GREY))
    for y in (-0.32 * size, 0.32 * size):  # landing skids
        foot = -vehicle.collision_radius
        parts.append(_box((0.8 * size, 0.04 * size, 0.04 * size), (0.0, y, foot + 0.02 * size), (0.0, 0.0, 0.0), DARK))
        for x in (-0.2 * size, 0.2 * size):
            parts.append(_box((0.03 * size, 0.03 * size, -foot), (x, y * 0.9, foot / 2), (0.0, 0.0, 0.0), DARK))
    return parts


def _box(
    size: tuple[float, float, float], at: tuple[float, float, float], rpy: tuple[float, float, float], colour: Colour
) -> Part:
    return _visual(f'<box size="{_numbers(size)}"/>', at, rpy, colour)


def _cylinder(radius: float, length: float, at: tuple[float, float, float], colour: Colour) -> Part:
    return _visual(f'<cylinder radius="{radius:.6g}" length="{length:.6g}"/>', at, (0.0, 0.0, 0.0), colour)


def _sphere(radius: float, at: tuple[float, float, float], colour: Colour) -> Part:
    return _visual(f'<sphere radius="{radius:.6g}"/>', at, (0.0, 0.0, 0.0), colour)


def _visual(geometry: str, at: tuple[float, float, float], rpy: tuple[float, float, float], colour: Colour) -> Part:
    name = "colour_" + "_".join(f"{round(255 * part):02x}" for part in colour)
    return colour, (
        f'<visual><origin xyz="{_numbers(at)}" rpy="{_numbers(rpy)}"/><geometry>{geometry}</geometry>'
        f'<material name="{name}"><color rgba="{_numbers(colour)}"/></material></visual>'
    )


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:.6g}" for value in values)


def _escape(text: str) -> str:
    return "".join(character if character.isalnum() or character in "-_" else "_" for character in text)
