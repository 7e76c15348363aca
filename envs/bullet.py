"""PyBullet's part of ``QuadcopterEnv``: the rigid body, and pictures of its flight."""

import sys
import time
import weakref

import numpy as np

from sb3_quad.base.arrays import FloatArray, Image
from sb3_quad.base.bullet import p
from sb3_quad.envs.rendering.camera import ChaseCamera
from sb3_quad.envs.rendering.models import rotor_turning
from sb3_quad.envs.rendering.scene import Pose, Scene
from sb3_quad.envs.rendering.window import (
    disconnect,
    has_display,
    open_window,
    point_window,
    start_drawing,
)
from sb3_quad.simulation.kernel import write_body
from sb3_quad.simulation.state import (
    FORCE_WORLD,
    POSITION,
    ROTOR_SPEEDS,
    TARGET,
    TORQUE_WORLD,
    P,
    QuadcopterState,
)
from sb3_quad.vehicles.vehicle import Vehicle

RENDER_MODES = ("human", "rgb_array")
WINDOW_FPS = 25.0  # frames a second; PyBullet's window lets the simulation wait for each
_ORIGIN = (0.0, 0.0, 0.0)


class BulletBody:
    """The rigid body of a vehicle in a PyBullet client of its own; several live side by side.

    PyBullet integrates a floating multibody base, which is what specification section 1 describes:
    explicit velocities, then the pose by the new velocities. The body is the only one in the
    simulation that can move or be touched; contact with the ground is decided by the task from the
    position, not here.

    :param vehicle: mass, inertia, gravity, collision radius and physics step.
    :param window: width and height in pixels of PyBullet's window, of which it allows one per
        process; None: no window. Without a display there is none either, and a line on stderr says
        so.
    :raises ConfigError: the window cannot be opened.
    """

    def __init__(self, vehicle: Vehicle, window: tuple[int, int] | None = None) -> None:
        self.has_window = window is not None and has_display()
        if window is not None and not self.has_window:
            print(
                "sb3_quad: DISPLAY is not set, so no window opens; render_mode='rgb_array' makes pictures",
                file=sys.stderr,
            )
        self.client = (
            open_window(*window)
            if window is not None and self.has_window
            else int(p.connect(p.DIRECT))
        )
        # Also runs when the object is forgotten without close() and at interpreter exit: PyBullet's
        # clients are limited.
        self._close = weakref.finalize(self, disconnect, self.client)
        p.setGravity(0.0, 0.0, -vehicle.gravity, physicsClientId=self.client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=vehicle.physics_step, numSubSteps=1, physicsClientId=self.client
        )
        ball = p.createCollisionShape(
            p.GEOM_SPHERE, radius=vehicle.collision_radius, physicsClientId=self.client
        )
        self.body = p.createMultiBody(vehicle.mass, ball, physicsClientId=self.client)
        p.changeDynamics(
            self.body, -1, linearDamping=0.0, angularDamping=0.0, physicsClientId=self.client
        )
        self.become(vehicle.parameters())
        p.setCollisionFilterGroupMask(self.body, -1, 0, 0, physicsClientId=self.client)

    def become(self, parameters: FloatArray) -> None:
        """Have the mass and inertia that a vehicle's ``parameters()`` say."""
        inertia = parameters[[P.ixx, P.iyy, P.izz]].tolist()
        p.changeDynamics(
            self.body,
            -1,
            mass=float(parameters[P.mass]),
            localInertiaDiagonal=inertia,
            physicsClientId=self.client,
        )

    @property
    def connected(self) -> bool:
        """Whether the simulation is still there: neither closed nor its window shut."""
        return self._close.alive and bool(p.isConnected(self.client))

    def place(self, state: QuadcopterState) -> None:
        """Put the body where the first vehicle of ``state`` is."""
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
        """One physics step for each force and torque at the centre of mass, (steps, 2, 3), body
        frame.

        :param wrench: (WRENCH_SIZE,), of which the world-frame parts act besides.
        :param drag: (3,), d of the vehicle, N s/m; None: there is none.
        :param wind: (3,), velocity of the air, world frame, m/s.
        """
        client, body = self.client, self.body
        push, twist, step = p.applyExternalForce, p.applyExternalTorque, p.stepSimulation
        world_force, world_torque = wrench[FORCE_WORLD].tolist(), wrench[TORQUE_WORLD].tolist()
        is_disturbed = any(world_force) or any(world_torque)
        for force, torque in wrenches.tolist():
            if is_disturbed:
                # A world-frame force acts at a point of the world: the centre of mass, where it is
                # now.
                position, _ = p.getBasePositionAndOrientation(body, physicsClientId=client)
                push(body, -1, world_force, position, p.WORLD_FRAME, physicsClientId=client)
                twist(body, -1, world_torque, p.WORLD_FRAME, physicsClientId=client)
            if drag is not None:
                force = np.add(force, self._drag(drag, wind))
            push(body, -1, force, _ORIGIN, p.LINK_FRAME, physicsClientId=client)
            twist(body, -1, torque, p.LINK_FRAME, physicsClientId=client)
            step(physicsClientId=client)

    def _drag(self, drag: FloatArray, wind: FloatArray) -> FloatArray:
        """The drag at the present velocity, (3,), body frame, N."""
        _, quaternion = p.getBasePositionAndOrientation(self.body, physicsClientId=self.client)
        velocity, _ = p.getBaseVelocity(self.body, physicsClientId=self.client)
        rotation = np.array(p.getMatrixFromQuaternion(quaternion)).reshape(3, 3)
        return np.asarray(-drag * (rotation.T @ (velocity - wind)))

    def read(self, state: FloatArray) -> None:
        """Write the body's pose and velocity into column 0 of ``state``, (STATE_SIZE, n)."""
        position, quaternion = p.getBasePositionAndOrientation(
            self.body, physicsClientId=self.client
        )
        write_body(
            state, position, quaternion, *p.getBaseVelocity(self.body, physicsClientId=self.client)
        )

    def close(self) -> None:
        """Disconnect this client, and no other; calling it twice is fine."""
        self._close()


class Renderer:
    """Draws one vehicle, its target and the wrench that acts on it; the flight is the same with and
    without it.

    :param width: of the pictures, pixels; ``height`` likewise.
    :param body: the simulation. If it has a window, that is drawn into, in real time.
    """

    def __init__(self, vehicle: Vehicle, width: int, height: int, body: BulletBody) -> None:
        self.vehicle, self.scene = vehicle, Scene(vehicle, body.client)
        self.size, self.human = (width, height), body.has_window
        self.shown_at, self.frames_due = time.perf_counter(), 1.0
        # PyBullet would draw the collision sphere.
        p.changeVisualShape(
            body.body, -1, rgbaColor=(0.0, 0.0, 0.0, 0.0), physicsClientId=body.client
        )
        self.reset(np.zeros(TARGET.stop))
        if self.human:
            start_drawing(self.scene.client)

    def reset(self, state: FloatArray) -> None:
        """A new episode: the camera jumps to where ``state``, (STATE_SIZE,), says."""
        self.rotor_angles = np.zeros(4)
        self.chase = ChaseCamera(self.scene.scale, *self.size)
        self.chase.follow(state, 1.0)

    def render(self, state: FloatArray, wrench: FloatArray) -> Image | None:
        """Draw a state, (STATE_SIZE,), and the wrench that acts, (12,); once for each control step.

        :return: uint8 (height, width, 3). None if there is a window: it is drawn WINDOW_FPS times a
            second, and this call waits until real time has caught up.
        """
        camera = self.chase.follow(state, 0.04)
        self.rotor_angles += (
            rotor_turning(self.vehicle, state[ROTOR_SPEEDS]) * self.vehicle.control_step
        )
        if not self.human:
            self._place(state, wrench)
            return self.scene.picture(camera)
        self.frames_due += WINDOW_FPS * self.vehicle.control_step
        if self.frames_due >= 1.0:
            self.frames_due %= 1.0
            self._place(state, wrench)
            point_window(self.scene.client, camera, state[POSITION])
        self.shown_at += self.vehicle.control_step
        ahead = self.shown_at - time.perf_counter()
        if ahead > 0:
            time.sleep(ahead)
        else:
            self.shown_at -= ahead  # too slow for real time: do not hurry afterwards
        return None

    def _place(self, state: FloatArray, wrench: FloatArray) -> None:
        self.scene.place([Pose(state, wrench, self.rotor_angles)], state[None, TARGET])
