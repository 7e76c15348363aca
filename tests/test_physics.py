"""The compiled control step against PyBullet, and its independence of batch size and position."""

import numpy as np
import pybullet
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import (
    BODY_RATES,
    POSITION,
    QUATERNION,
    ROTOR_SPEEDS,
    STATE_SIZE,
    VELOCITY,
)
from sb3_quad.envs.vehicles.vehicle import Vehicle, load_vehicle

URDF = """<robot name="body"><link name="base"><inertial><mass value="{m!r}"/>
<inertia ixx="{i[0]!r}" iyy="{i[1]!r}" izz="{i[2]!r}"
 ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
ITM = load_vehicle("itm")


class BulletReference:
    """One body in PyBullet, pushed by rotors that this test works out by itself."""

    def __init__(self, vehicle, folder, state):
        path = folder / "body.urdf"
        path.write_text(URDF.format(m=vehicle.mass, i=vehicle.inertia))
        self.vehicle, self.client = vehicle, {"physicsClientId": pybullet.connect(pybullet.DIRECT)}
        pybullet.setGravity(0, 0, -vehicle.gravity, **self.client)
        pybullet.setTimeStep(vehicle.physics_step, **self.client)
        self.body = pybullet.loadURDF(
            str(path), flags=pybullet.URDF_USE_INERTIA_FROM_FILE, **self.client
        )
        pybullet.changeDynamics(self.body, -1, linearDamping=0, angularDamping=0, **self.client)
        if vehicle.allow_impossible_inertia:
            # The reader of URDF files sets such an inertia to zero.
            inertia = list(vehicle.inertia)
            pybullet.changeDynamics(self.body, -1, localInertiaDiagonal=inertia, **self.client)
        w, x, y, z = state[QUATERNION]
        pybullet.resetBasePositionAndOrientation(
            self.body, state[POSITION], (x, y, z, w), **self.client
        )
        rates = self.rotation((x, y, z, w)) @ state[BODY_RATES]
        pybullet.resetBaseVelocity(self.body, state[VELOCITY], rates, **self.client)
        self.speeds = state[ROTOR_SPEEDS].copy()
        hover = np.sqrt(vehicle.hover_thrusts / vehicle.lift)
        self.waiting = [hover] * vehicle.delay

    @staticmethod
    def rotation(quaternion):
        return np.array(pybullet.getMatrixFromQuaternion(quaternion)).reshape(3, 3)

    def fly(self, action, wrench, wind):
        vehicle, body, client = self.vehicle, self.body, self.client
        thrust = vehicle.action_to_thrust(action.astype(np.float64))
        self.waiting.append(np.sqrt(thrust / vehicle.lift))
        wanted = self.waiting.pop(0)
        for _ in range(vehicle.substeps):
            share = (
                np.where(wanted > self.speeds, vehicle.motor_gain_up, vehicle.motor_gain_down)
                * vehicle.physics_step
            )
            before, exact = self.speeds, vehicle.motor_integration == "exact"
            share = share / (1 + share / 2 + share**2 / 12) if exact else share
            self.speeds = before + (wanted - before) * share
            thrust = vehicle.lift * self.speeds * (before if exact else self.speeds)
            lift, *moments = vehicle.mixer @ thrust
            centre, attitude = pybullet.getBasePositionAndOrientation(body, **client)
            r = self.rotation(attitude)
            velocity, rates = pybullet.getBaseVelocity(body, **client)
            airspeed, rates = r.T @ (np.array(velocity) - wind), r.T @ rates
            radius, total = vehicle.ground_effect_radius, self.speeds.sum()
            near = 1 / (1 - (radius / (4 * max(centre[2], radius / 2, 1e-9))) ** 2)
            lift, moments = lift * near, near * np.array(moments)
            lift += vehicle.translational_lift * (airspeed[0] ** 2 + airspeed[1] ** 2)
            drag = np.array(vehicle.drag) + total * np.array(vehicle.rotor_drag)
            force = wrench[3:6] + np.array([0.0, 0.0, lift]) - drag * airspeed
            roll, pitch = total * np.array(vehicle.airspeed_moment)
            moments += np.array([roll * airspeed[1], -pitch * airspeed[0], 0.0])
            moments -= np.array(vehicle.rate_damping) * rates
            spins = -vehicle.rotor_inertia * np.array(vehicle.rotor_directions)
            moments -= np.cross(rates, [0.0, 0.0, spins @ self.speeds])
            moments[2] -= spins @ (self.speeds - before) / vehicle.physics_step
            pybullet.applyExternalForce(
                body, -1, wrench[:3], centre, pybullet.WORLD_FRAME, **client
            )
            pybullet.applyExternalForce(body, -1, force, (0, 0, 0), pybullet.LINK_FRAME, **client)
            pybullet.applyExternalTorque(body, -1, wrench[6:9], pybullet.WORLD_FRAME, **client)
            pybullet.applyExternalTorque(
                body, -1, wrench[9:] + moments, pybullet.LINK_FRAME, **client
            )
            pybullet.stepSimulation(**client)
        position, quaternion = pybullet.getBasePositionAndOrientation(body, **client)
        velocity, rates = pybullet.getBaseVelocity(body, **client)
        x, y, z, w = quaternion
        return np.concatenate(
            [position, (w, x, y, z), velocity, self.rotation(quaternion).T @ rates, self.speeds]
        )

    def close(self):
        pybullet.disconnect(**self.client)


def random_state(rng, vehicle, velocity=5.0, rates=8.0):
    state = np.zeros(STATE_SIZE)
    state[POSITION] = rng.normal(size=3) * 10
    state[QUATERNION] = rng.normal(size=4)
    state[QUATERNION] /= np.linalg.norm(state[QUATERNION])
    state[VELOCITY], state[BODY_RATES] = rng.normal(size=3) * velocity, rng.normal(size=3) * rates
    state[ROTOR_SPEEDS] = vehicle.hover_rotor_speed * rng.uniform(0.8, 1.2, size=4)
    return state


def random_actions(rng, steps):
    """Full deflection for a fifth of a second at a time, disturbed, at times beyond the limits."""
    held = np.repeat(rng.choice([-1.0, 1.0], size=(steps // 20 + 1, 4)), 20, axis=0)[:steps]
    return (held + 0.5 * rng.normal(size=(steps, 4))).astype(np.float32)


def batch_of(vehicles, states, wrenches, wind=(0.0, 0.0, 0.0)):
    """Rows in these states, that fly on wherever they are."""
    batch = QuadcopterBatch(
        states.shape[1],
        FlightSettings(vehicle=vehicles, noise=0.0, max_episode_steps=10**6),
        n_threads=1,
        autoreset=False,
    )
    batch.reset()
    batch.state[:], batch.wrench[:] = states, wrenches
    batch.wind.T[:] = wind
    return batch


def fly(vehicle, states, actions, wrenches, *wind):
    """The states after each control step, (steps, STATE_SIZE, n), of n vehicles of one kind."""
    batch = batch_of(vehicle, states, wrenches, *wind)
    history = []
    for action in actions:
        batch.step(action)
        history.append(batch.state.copy())
    return np.array(history)


def worst_difference(vehicle, folder, state, actions, wrench, wind=(0.0, 0.0, 0.0)):
    """Greatest distance to PyBullet in each number, over all control steps."""
    reference = BulletReference(vehicle, folder, state)
    try:
        flown = fly(vehicle, state[:, None], actions[:, None], wrench[:, None], wind)[:, :17, 0]
        expected = np.array([reference.fly(action, wrench, wind) for action in actions])
    finally:
        reference.close()
    sign = np.sign(np.einsum("ti,ti->t", flown[:, QUATERNION], expected[:, QUATERNION]))
    expected[:, QUATERNION] *= sign[:, None]
    return np.abs(flown - expected).max(axis=0)


def air(size, random):
    """Fields of the terms of aerodynamics.py."""
    each = random.uniform
    return {
        "rotor_drag": [size**2 * each(0, 2e-4) for _ in range(3)],
        "translational_lift": size**2 * each(0, 0.02),
        "airspeed_moment": [size**5 * each(-1e-5, 3e-5) for _ in range(2)],
        "rate_damping": [size**5 * each(0, 0.05) for _ in range(3)],
        "rotor_inertia": size**5 * each(0, 2e-4),
        "ground_effect_radius": size * each(0, 40),
        "thrust_factors": [each(0.9, 1.1) for _ in range(4)],
    }


@st.composite
def vehicles(draw):
    size = draw(st.floats(0.3, 3.0))
    spread = draw(st.tuples(st.floats(0.8, 1.2), st.floats(0.8, 1.2), st.floats(0.8, 1.2)))
    arm = 0.17 * size
    x, y = draw(st.just((0.0, 0.0)) | st.tuples(st.floats(-0.25, 0.25), st.floats(-0.25, 0.25)))
    places = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)]) - (x, y)
    # Hover takes from 1 - |x| - |y| to 1 + |x| + |y| of m g / 4. A rotor's speed is a root, which
    # magnifies the rounding of almost 0.
    off = abs(x) + abs(y)
    least = draw(st.just(0.0) | st.floats(0.01, 0.8 * (1.0 - off)))
    return Vehicle(
        name="random",
        mass=1.7 * size**3,
        inertia=tuple(0.009 * size**5 * factor for factor in spread),
        rotor_positions=(arm * places).tolist(),
        rotor_directions=(1, -1, 1, -1),
        moment_thrust_ratio=draw(st.floats(0.005, 0.05)),
        thrust_coefficient=draw(st.just(0.0) | st.floats(1e-7, 1e-4)),
        motor_gain_up=draw(st.floats(5.0, 60.0)),
        motor_gain_down=draw(st.floats(5.0, 60.0)),
        motor_integration=draw(st.sampled_from(["euler", "exact"])),
        drag=draw(st.just((0.0, 0.0, 0.0)) | st.tuples(*[st.floats(0.0, 1.0)] * 3)),
        gravity=draw(st.floats(1.6, 12.0)),
        thrust_limits=(least, draw(st.floats(1.2, 1.5)) + off),
        delay=draw(st.integers(0, 3)),
        **draw(st.just({}) | st.builds(air, st.just(size), st.randoms())),
        collision_radius=0.1,
    )


@settings(
    max_examples=settings().max_examples // 4,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.filter_too_much],
)
@given(vehicle=vehicles(), seed=st.integers(0, 2**32 - 1), pushed=st.booleans())
def test_flight_is_pybullets(vehicle, seed, pushed, tmp_path_factory):
    rng = np.random.default_rng(seed)
    state, actions = random_state(rng, vehicle), random_actions(rng, 400)
    size = vehicle.mass * vehicle.gravity
    scale = np.repeat([0.2 * size, 0.2 * size, 1e-3 * size, 1e-3 * size], 3)
    wrench, wind = pushed * scale * rng.normal(size=12), pushed * 5.0 * rng.normal(size=3)
    folder = tmp_path_factory.mktemp("bullet")
    # Where PyBullet cuts velocities at 100 rad/s rounding grows fast; another test is about that.
    assume(
        np.abs(
            fly(vehicle, state[:, None], actions[:, None], wrench[:, None], wind)[:, BODY_RATES]
        ).max()
        <= 60.0
    )
    assert worst_difference(vehicle, folder, state, actions, wrench, wind).max() < 1e-9


def test_flight_of_an_impossible_inertia_is_pybullets(tmp_path):
    changes = {"inertia": (0.01, 0.01, 0.025), "allow_impossible_inertia": True}
    vehicle, rng = ITM.model_copy(update=changes), np.random.default_rng(4)
    state, actions = random_state(rng, vehicle), random_actions(rng, 400)
    assert worst_difference(vehicle, tmp_path, state, actions, np.zeros(12)).max() < 1e-9


@pytest.mark.parametrize("name", ["crazyflie", "hummingbird", "itm"])
def test_flight_of_the_shipped_vehicles_is_pybullets(name, tmp_path):
    """Full deflection for 0.1 s at most at a time: longer, and a small vehicle spins faster than
    PyBullet is exact at.
    """
    vehicle, rng = load_vehicle(name), np.random.default_rng(0)
    state = random_state(rng, vehicle)
    actions = np.clip(
        random_actions(rng, 200)[::2] * rng.choice([-1.0, 1.0], size=(100, 4)), -1, 1
    ).astype(np.float32)
    wrench = np.zeros(12)
    assert (
        np.abs(fly(vehicle, state[:, None], actions[:, None], wrench[:, None])[:, BODY_RATES]).max()
        < 60.0
    )
    assert worst_difference(vehicle, tmp_path, state, actions, wrench).max() < 1e-9


def test_another_physics_step(tmp_path):
    vehicle = ITM.model_copy(update={"physics_step": 0.0005, "control_step": 0.01})
    rng = np.random.default_rng(3)
    state, actions = random_state(rng, vehicle), random_actions(rng, 200)
    assert worst_difference(vehicle, tmp_path, state, actions, np.zeros(12)).max() < 1e-9


def test_velocities_are_cut_as_pybullet_cuts_them(tmp_path):
    rng = np.random.default_rng(0)
    state = random_state(rng, ITM, velocity=90.0, rates=55.0)
    wrench = np.array([90.0, -30.0, 80.0, 0, 0, 0, 0.3, 0.2, -0.4, 0, 0, 0])
    actions = np.zeros((60, 4), dtype=np.float32)
    flown = fly(ITM, state[:, None], actions[:, None], wrench[:, None])
    assert np.abs(flown[:, VELOCITY]).max() == 100.0
    assert np.linalg.norm(flown[:, BODY_RATES], axis=1).max() > 100.0
    assert worst_difference(ITM, tmp_path, state, actions, wrench).max() < 1e-9


def test_rows_do_not_depend_on_the_batch():
    rng = np.random.default_rng(5)
    n, steps = 150, 30
    states = np.stack([random_state(rng, ITM) for _ in range(n)], axis=1)
    states[BODY_RATES, 70] *= 15.0  # one row beyond PyBullet's cut must not touch its neighbours
    wrenches = rng.normal(size=(12, n)) * (rng.random(n) < 0.3)
    actions = np.stack([random_actions(rng, steps) for _ in range(n)], axis=1)
    together = fly(ITM, states, actions, wrenches)
    for row in (0, 1, 63, 64, 70, 71, 127, 128, 149):
        alone = fly(ITM, states[:, [row]], actions[:, [row]], wrenches[:, [row]])
        np.testing.assert_array_equal(alone[:, :, 0], together[:, :, row])


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_a_command_acts_after_the_delay(delay):
    vehicle = ITM.model_copy(update={"delay": delay})
    state = random_state(np.random.default_rng(0), vehicle)[:, None]
    state[ROTOR_SPEEDS] = vehicle.hover_rotor_speed
    actions = np.zeros((6, 1, 4), dtype=np.float32)
    actions[1:] = 1.0
    speeds = fly(vehicle, state, actions, np.zeros((12, 1)))[:, ROTOR_SPEEDS, 0]
    moved = np.abs(speeds - vehicle.hover_rotor_speed).max(axis=1) > 1e-6
    assert moved.tolist() == [step >= 1 + delay for step in range(6)]
