"""PyBullet's part of ``QuadcopterEnv``: the rigid body, and pictures of its flight."""

import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from sb3_quad.base.types import FloatArray, Image
from sb3_quad.envs.rendering.bullet_client import p
from sb3_quad.envs.rendering.camera import MARGIN, WIDE, Lens, chasing, framing_camera
from sb3_quad.envs.rendering.picture import draw, relative_size
from sb3_quad.envs.simulation.physics import rotation_rows, to_body
from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    STATE_SIZE,
    TARGET,
    VELOCITY,
    P,
    QuadcopterState,
)
from sb3_quad.envs.vehicles.vehicle import Vehicle

Air = Callable[[int, FloatArray], FloatArray]
RENDER_MODES = ("human", "rgb_array")
_ORIGIN = (0.0, 0.0, 0.0)


class Client:
    """PyBullet's functions, bound to a new simulation: ``client.stepSimulation()`` is
    ``p.stepSimulation(physicsClientId=client.number)``.
    """

    def __init__(self) -> None:
        self.number = int(p.connect(p.DIRECT))
        if self.number < 0:
            raise p.error("no connection")

    def __getattr__(self, name: str) -> Any:
        function = partial(getattr(p, name), physicsClientId=self.number)
        # Kept, so that each function is looked up once.
        vars(self)[name] = function
        return function

    def close(self) -> None:
        """End the simulation, unless it has ended already."""
        if self.isConnected():
            self.disconnect()


class BulletBody:
    """The rigid body of a vehicle in its own PyBullet client; several can exist at once.

    PyBullet integrates a floating multibody base: first explicit steps of the velocities, then the
    pose by the new velocities. The body has no collision shape, so it touches nothing: the task
    decides about contact with the ground by the position.

    :param vehicle: mass, inertia, gravity and physics step.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        client = Client()
        self.client = client
        # The number of PyBullet's clients is limited, so this one is also closed if the object is
        # garbage-collected without close(), and when the interpreter exits.
        self._close = weakref.finalize(self, client.close)

        client.setGravity(0.0, 0.0, -vehicle.gravity)
        client.setTimeStep(vehicle.physics_step)
        self.body = client.createMultiBody(vehicle.mass)
        self.become(vehicle.parameters())

    def become(self, parameters: FloatArray) -> None:
        """Take on the mass and inertia in a vehicle's ``parameters()``."""
        # Without damping by PyBullet itself; the air acts in :meth:`fly`.
        self.client.changeDynamics(
            self.body,
            -1,
            mass=parameters[P.mass],
            localInertiaDiagonal=parameters[[P.ixx, P.iyy, P.izz]],
            linearDamping=0.0,
            angularDamping=0.0,
        )

    @property
    def connected(self) -> bool:
        """Whether the simulation has not been closed."""
        return self._close.alive and bool(self.client.isConnected())

    def place(self, state: QuadcopterState) -> None:
        """Put the body where the first vehicle of ``state`` is."""
        # PyBullet's quaternions end with w, and its angular velocities are in the world frame.
        attitude = np.roll(state.quaternion[0], -1)
        rates = state.rotation[0] @ state.body_rates[0]
        self.client.resetBasePositionAndOrientation(self.body, state.position[0], attitude)
        self.client.resetBaseVelocity(self.body, state.velocity[0], rates)

    def fly(self, rotors: FloatArray, wrench: FloatArray, air: Air | None = None) -> None:
        """Simulate one physics step for each of ``rotors``.

        :param rotors: (steps, 2, 3), force and torque of the rotors, body frame.
        :param wrench: (WRENCH_SIZE,), the external wrench at the centre of mass.
        :param air: returns the wrench of the air, (WRENCH_SIZE,), in a physics step of this number,
            from the body's state before it, (STATE_SIZE, 1); None: no air.
        """
        client = self.client
        body = self.body
        total = wrench
        for step, rotor in enumerate(rotors):
            # The air depends on the velocity, which changes in each physics step.
            if air is not None:
                state = np.zeros((STATE_SIZE, 1))
                self.read(state)
                total = wrench + air(step, state)
            parts = total.reshape(4, 3)
            world_force, world_torque = parts[::2].tolist()
            # Calls of PyBullet are slow, so leave out those that do nothing.
            if any(world_force) or any(world_torque):
                # PyBullet applies a world-frame force at a point of the world: the present centre
                # of mass.
                position, _ = client.getBasePositionAndOrientation(body)
                client.applyExternalForce(body, -1, world_force, position, p.WORLD_FRAME)
                client.applyExternalTorque(body, -1, world_torque, p.WORLD_FRAME)
            force, torque = (rotor + parts[1::2]).tolist()
            client.applyExternalForce(body, -1, force, _ORIGIN, p.LINK_FRAME)
            client.applyExternalTorque(body, -1, torque, p.LINK_FRAME)
            client.stepSimulation()

    def read(self, state: FloatArray) -> None:
        """Write the body's pose and velocity into column 0 of ``state``, (STATE_SIZE, n)."""
        position, (x, y, z, w) = self.client.getBasePositionAndOrientation(self.body)
        velocity, rates = self.client.getBaseVelocity(self.body)
        state[POSITION, 0] = position
        state[QUATERNION, 0] = w, x, y, z
        state[VELOCITY, 0] = velocity
        # PyBullet's angular velocities are in the world frame.
        state[BODY_RATES, 0] = to_body(rotation_rows(w, x, y, z), rates)

    def close(self) -> None:
        """Disconnect this client, and no other; calling it twice is fine."""
        self._close()


class Renderer:
    """Draws one vehicle and its target. It does not change the flight.

    :param width: width of the pictures, pixels.
    :param height: height of the pictures, pixels.
    """

    def __init__(self, vehicle: Vehicle, width: int, height: int) -> None:
        self.vehicle = vehicle
        self.lens = Lens(width, height, WIDE)
        self.reset(np.zeros(TARGET.stop))

    def reset(self, state: FloatArray) -> None:
        """Begin an episode in ``state``, (STATE_SIZE,): the camera looks along the way to the
        target.
        """
        self.forward = chasing(state[TARGET] - state[POSITION])

    def render(self, state: FloatArray) -> Image:
        """Return the picture of a state, (STATE_SIZE,): uint8 (height, width, 3)."""
        # Vehicle and target must both be in the picture.
        both = np.stack([state[POSITION], state[TARGET]])
        margin = MARGIN * relative_size(self.vehicle)
        camera = framing_camera(both, margin, self.forward, self.lens)
        return np.array(draw(self.vehicle, state, camera))
