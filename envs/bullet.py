"""PyBullet's part of ``QuadcopterEnv``: the rigid body, and pictures of its flight."""

import sys
import time
import weakref

import numpy as np

from sb3_quad.base.bullet import p
from sb3_quad.base.types import FloatArray, Image
from sb3_quad.envs.rendering.camera import CHASE_MARGIN, CHASE_SLOPE, Lens, chasing, framing_camera
from sb3_quad.envs.rendering.models import rotor_turning
from sb3_quad.envs.rendering.scene import Pose, Scene
from sb3_quad.envs.rendering.window import (
    disconnect,
    has_display,
    open_window,
    point_window,
    start_drawing,
)
from sb3_quad.simulation.physics import rotation_rows, to_body
from sb3_quad.simulation.state import (
    BODY_RATES,
    FORCE_WORLD,
    POSITION,
    QUATERNION,
    ROTOR_SPEEDS,
    TARGET,
    TORQUE_WORLD,
    VELOCITY,
    P,
    QuadcopterState,
)
from sb3_quad.vehicles.vehicle import Vehicle

RENDER_MODES = ("human", "rgb_array")
# PyBullet's window makes the simulation wait for each frame, so it draws only so many per second.
WINDOW_FPS = 25.0
_ORIGIN = (0.0, 0.0, 0.0)


class BulletBody:
    """The rigid body of a vehicle in a PyBullet client of its own; several can exist at once.

    PyBullet integrates a floating multibody base, which is what specification section 1 describes:
    explicit velocities, then the pose by the new velocities. Nothing else in the simulation can
    move or be touched. The task decides on contact with the ground by the position, not PyBullet.

    :param vehicle: mass, inertia, gravity, collision radius and physics step.
    :param window: width and height in pixels of PyBullet's window, one per process; None: no
        window. Without a display no window opens either, and a line on stderr says why.
    :raises ConfigError: the window cannot be opened.
    """

    def __init__(self, vehicle: Vehicle, window: tuple[int, int] | None = None) -> None:
        if window is not None and not has_display():
            sys.stderr.write(
                "sb3_quad: DISPLAY is not set, so no window opens; "
                "render_mode='rgb_array' makes pictures\n"
            )
            window = None
        self.has_window = window is not None
        client = self.client = open_window(*window) if window else int(p.connect(p.DIRECT))
        # The number of PyBullet's clients is limited, so this one is also closed if the object is
        # garbage-collected without close(), and when the interpreter exits.
        self._close = weakref.finalize(self, disconnect, client)

        # A sphere without damping by PyBullet itself; drag is added in :meth:`fly`.
        p.setGravity(0.0, 0.0, -vehicle.gravity, physicsClientId=client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=vehicle.physics_step, numSubSteps=1, physicsClientId=client
        )
        ball = p.createCollisionShape(
            p.GEOM_SPHERE, radius=vehicle.collision_radius, physicsClientId=client
        )
        self.body = p.createMultiBody(vehicle.mass, ball, physicsClientId=client)
        self.become(vehicle.parameters())
        # The body must not collide with the ground or a target that is drawn.
        p.setCollisionFilterGroupMask(self.body, -1, 0, 0, physicsClientId=client)

    def become(self, parameters: FloatArray) -> None:
        """Take on the mass and inertia in a vehicle's ``parameters()``."""
        p.changeDynamics(
            self.body,
            -1,
            mass=float(parameters[P.mass]),
            localInertiaDiagonal=parameters[[P.ixx, P.iyy, P.izz]].tolist(),
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=self.client,
        )

    @property
    def connected(self) -> bool:
        """Whether the simulation exists: it was not closed, and its window was not shut."""
        return self._close.alive and bool(p.isConnected(self.client))

    def place(self, state: QuadcopterState) -> None:
        """Put the body where the first vehicle of ``state`` is."""
        # PyBullet's quaternions end with w, and its angular velocities are in the world frame.
        w, x, y, z = state.quaternion[0].tolist()
        rates = state.rotation[0] @ state.body_rates[0]
        p.resetBasePositionAndOrientation(
            self.body, state.position[0].tolist(), (x, y, z, w), physicsClientId=self.client
        )
        p.resetBaseVelocity(
            self.body, state.velocity[0].tolist(), rates.tolist(), physicsClientId=self.client
        )

    def fly(
        self, wrenches: FloatArray, wrench: FloatArray, drag: FloatArray | None, wind: FloatArray
    ) -> None:
        """Simulate one physics step for each of ``wrenches``.

        :param wrenches: (steps, 2, 3), force and torque at the centre of mass, body frame.
        :param wrench: (WRENCH_SIZE,), the external wrench; its world-frame parts act as well.
        :param drag: (3,), d of the vehicle, N s/m; None: no drag.
        :param wind: (3,), velocity of the air, world frame, m/s.
        """
        client = self.client
        body = self.body
        world_force = wrench[FORCE_WORLD].tolist()
        world_torque = wrench[TORQUE_WORLD].tolist()
        # Calls of PyBullet are slow, so leave out those that do nothing.
        is_disturbed = any(world_force) or any(world_torque)
        for force, torque in wrenches.tolist():
            if is_disturbed:
                # A world-frame force acts at a point of the world: where the centre of mass is now.
                position, _ = p.getBasePositionAndOrientation(body, physicsClientId=client)
                p.applyExternalForce(
                    body, -1, world_force, position, p.WORLD_FRAME, physicsClientId=client
                )
                p.applyExternalTorque(body, -1, world_torque, p.WORLD_FRAME, physicsClientId=client)
            # Drag depends on the velocity, which differs by physics step.
            if drag is not None:
                force = np.add(force, self._drag(drag, wind))
            p.applyExternalForce(body, -1, force, _ORIGIN, p.LINK_FRAME, physicsClientId=client)
            p.applyExternalTorque(body, -1, torque, p.LINK_FRAME, physicsClientId=client)
            p.stepSimulation(physicsClientId=client)

    def _drag(self, drag: FloatArray, wind: FloatArray) -> FloatArray:
        """Return the drag at the current velocity, (3,), body frame, N."""
        _, quaternion = p.getBasePositionAndOrientation(self.body, physicsClientId=self.client)
        velocity, _ = p.getBaseVelocity(self.body, physicsClientId=self.client)
        rotation = np.array(p.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
        return np.asarray(-drag * (rotation.T @ (velocity - wind)))

    def read(self, state: FloatArray) -> None:
        """Write the body's pose and velocity into column 0 of ``state``, (STATE_SIZE, n)."""
        position, (x, y, z, w) = p.getBasePositionAndOrientation(
            self.body, physicsClientId=self.client
        )
        velocity, rates = p.getBaseVelocity(self.body, physicsClientId=self.client)
        state[POSITION, 0] = position
        state[QUATERNION, 0] = w, x, y, z
        state[VELOCITY, 0] = velocity
        # PyBullet's body rates are in the world frame.
        state[BODY_RATES, 0] = to_body(rotation_rows(w, x, y, z), rates)

    def close(self) -> None:
        """Disconnect this client, and no other; calling it twice is fine."""
        self._close()


class Renderer:
    """Draws one vehicle, its target and the wrench that acts on it. It does not change the flight.

    :param width: width of the pictures, pixels.
    :param height: height of the pictures, pixels.
    :param body: the simulation. If it has a window, the renderer draws into it, in real time.
    """

    def __init__(self, vehicle: Vehicle, width: int, height: int, body: BulletBody) -> None:
        self.vehicle = vehicle
        self.scene = Scene(vehicle, body.client)
        self.lens = Lens(width, height, CHASE_SLOPE)
        self.human = body.has_window
        self.shown_at = time.perf_counter()
        self.frames_due = 1.0
        # Otherwise PyBullet draws the collision sphere.
        p.changeVisualShape(
            body.body, -1, rgbaColor=(0.0, 0.0, 0.0, 0.0), physicsClientId=body.client
        )
        self.reset(np.zeros(TARGET.stop))
        if self.human:
            start_drawing(self.scene.client)

    def reset(self, state: FloatArray) -> None:
        """Begin an episode in ``state``, (STATE_SIZE,): the camera looks along the way to the
        target.
        """
        self.rotor_angles = np.zeros(4)
        self.forward = chasing(state[TARGET] - state[POSITION])

    def render(self, state: FloatArray, wrench: FloatArray) -> Image | None:
        """Draw a state, (STATE_SIZE,), and the wrench that acts, (12,). Call it every control step.

        :return: uint8 (height, width, 3). If there is a window, None: it shows WINDOW_FPS frames a
            second, and this call waits until real time has caught up.
        """
        control_step = self.vehicle.control_step
        self.rotor_angles += rotor_turning(self.vehicle, state[ROTOR_SPEEDS]) * control_step
        if self.human:
            # Wait for real time. After a step that took longer, do not hurry.
            now = time.perf_counter()
            self.shown_at = max(self.shown_at + control_step, now)
            time.sleep(self.shown_at - now)
            self.frames_due += WINDOW_FPS * control_step
            if self.frames_due < 1.0:
                return None
            self.frames_due %= 1.0
        self.scene.place([Pose(state, wrench, self.rotor_angles)], state[None, TARGET])
        # Vehicle and target are in the picture.
        both = np.stack([state[POSITION], state[TARGET]])
        camera = framing_camera(both, CHASE_MARGIN * self.scene.scale, self.forward, self.lens)
        if not self.human:
            return self.scene.picture(camera)
        point_window(self.scene.client, camera, state[POSITION])
        return None
