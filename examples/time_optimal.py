"""The least time in which a vehicle gets within 0.1 m of a target, to stay and to rest there.

    pip install casadi
    python examples/time_optimal.py itm
    python examples/time_optimal.py my.yaml --distances 10 20 --directions 12

The vehicle hovers until the first command acts, after its delay. Its rotors then speed up and slow
down as fast as their motor gains and limits let them (Eq. 4.1). The full model is discretized by
direct collocation (Hermite-Simpson), and IPOPT solves it, starting from the flight of the geometric
expert. Each time is thus a local minimum: it bounds what a controller can do, unless another kind
of flight is quicker. The directions are spread evenly over the sphere.
"""

import argparse

import casadi as ca
import numpy as np

from sb3_quad.envs.simulation.batch import QuadcopterBatch
from sb3_quad.envs.simulation.settings import FlightSettings
from sb3_quad.envs.simulation.state import TARGET
from sb3_quad.envs.vehicles.vehicle import Vehicle, load_vehicle
from sb3_quad.experts.geometric import GeometricExpert

NEAR = 0.1  # m
START = 100.0  # m; the height of the start, so that the ground does not matter
WAY = 60  # intervals until it is near
REST = 20  # intervals from then to rest
REST_TIME = 1.0  # s, at most
# Sizes of the parts of a state. Rotor speeds are relative to that of hover.
STATES = {"position": 3, "quaternion": 4, "velocity": 3, "rates": 3, "speeds": 4}


def rates_of_change(vehicle: Vehicle) -> ca.Function:
    """Return the derivative of the state, a function of the state and the rotors' accelerations."""
    state = ca.SX.sym("state", sum(STATES.values()))
    turn = ca.SX.sym("turn", 4)
    _, q, v, w, speeds = ca.vertsplit(state, np.cumsum([0, *STATES.values()]).tolist())
    qw, qx, qy, qz = ca.vertsplit(q)
    rotation = ca.blockcat(
        [
            [1 - 2 * (qy**2 + qz**2), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)],
            [2 * (qx * qy + qw * qz), 1 - 2 * (qx**2 + qz**2), 2 * (qy * qz - qw * qx)],
            [2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx**2 + qy**2)],
        ]
    )
    total = ca.DM(vehicle.mixer) @ (vehicle.hover_thrust * speeds**2)  # thrust and moments
    force = rotation @ (ca.vertcat(0, 0, total[0]) - ca.DM(vehicle.drag) * (rotation.T @ v))
    inertia = ca.DM(vehicle.inertia)
    spin = (total[1:] - ca.cross(w, inertia * w)) / inertia
    turning = 0.5 * ca.vertcat(-ca.dot(q[1:], w), qw * w + ca.cross(q[1:], w))
    acceleration = force / vehicle.mass - ca.DM([0, 0, vehicle.gravity])
    derivative = ca.vertcat(v, turning, acceleration, spin, turn)
    return ca.Function("f", [state, turn], [derivative])


def least_time(vehicle: Vehicle, way: np.ndarray) -> float:
    """Return the seconds from hover until the vehicle is near a target, infinite if IPOPT fails.

    :param way: vector to the target, (3,), m.
    """
    f = rates_of_change(vehicle)
    problem = ca.Opti()
    n = WAY + REST
    size = sum(STATES.values())
    # States and inputs at the ends of the intervals, inputs in their middle, the two durations, s.
    x = problem.variable(size, n + 1)
    u = problem.variable(4, n + 1)
    middle = problem.variable(4, n)
    durations = problem.variable(2)

    # Hermite-Simpson: the state in the middle follows from a cubic, and Simpson's rule integrates.
    h = ca.horzcat(*[durations[0] / WAY] * WAY, *[durations[1] / REST] * REST)
    steps = ca.repmat(h, size, 1)
    slope = f.map(n + 1)(x, u)
    half = (x[:, :-1] + x[:, 1:]) / 2 + steps / 8 * (slope[:, :-1] - slope[:, 1:])
    slopes = slope[:, :-1] + 4 * f.map(n)(half, middle) + slope[:, 1:]
    problem.subject_to(x[:, 1:] - x[:, :-1] == steps / 6 * slopes)

    # The rotors follow commands within their limits, by Eq. 4.1.
    low, high = np.sqrt(vehicle.thrust_limits)
    for turn, speeds in ((u, x[13:, :]), (middle, half[13:, :])):
        problem.subject_to(ca.vec(turn - vehicle.motor_gain_up * (high - speeds)) <= 0)
        problem.subject_to(ca.vec(turn - vehicle.motor_gain_down * (low - speeds)) >= 0)

    # From hover to within NEAR of the target, and from then on it stays there.
    hover_speeds = np.sqrt(vehicle.hover_shares)
    hover = np.concatenate([[0, 0, 0, 1], np.zeros(9), hover_speeds])
    problem.subject_to(x[:, 0] == hover)
    problem.subject_to(problem.bounded(0.05, durations, [20.0, REST_TIME]))
    problem.subject_to(ca.vec(ca.sum1((x[:3, WAY:] - ca.repmat(way, 1, REST + 1)) ** 2)) <= NEAR**2)
    # At rest at the end: level, in any heading.
    problem.subject_to(x[4:6, -1] == 0)
    problem.subject_to(x[7:13, -1] == 0)
    problem.subject_to(x[13:, -1] == hover_speeds)
    problem.minimize(durations[0])

    guess, seconds = flight(vehicle, way)
    problem.set_initial(x, guess)
    problem.set_initial(durations, seconds)
    problem.solver(
        "ipopt", {"print_time": False}, {"print_level": 0, "max_iter": 1000, "sb": "yes"}
    )
    try:
        solution = problem.solve()
    except RuntimeError:
        return float("inf")
    return float(solution.value(durations[0])) + vehicle.delay * vehicle.control_step


def flight(vehicle: Vehicle, way: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Fly the geometric expert to the target.

    :returns: its states at the ends of the intervals, and the durations of its two parts, s.
    """
    settings = FlightSettings(
        task_kwargs={"start_position": (0.0, 0.0, START)},
        vehicle=vehicle,
        noise=0.0,
        max_episode_steps=3000,
    )
    batch = QuadcopterBatch(1, settings, seed=0, autoreset=False)
    expert = GeometricExpert(vehicle)
    states = []
    distance = []
    batch.reset()
    start = batch.true_state().position[0].copy()
    batch.state[TARGET, 0] = start + way
    for _ in range(1500):
        s = batch.state[:, 0]
        states.append([*(s[:3] - start), *s[3:13], *(s[13:17] / vehicle.hover_rotor_speed)])
        distance.append(batch.true_state().distance[0])
        batch.step(expert.actions(batch.true_state()))
    near = int(np.flatnonzero(np.array(distance) > NEAR)[-1]) + 1
    seconds = [near * vehicle.control_step, 0.5 * REST_TIME]
    to_target = np.linspace(0, seconds[0], WAY + 1)
    to_rest = seconds[0] + np.linspace(0, seconds[1], REST + 1)[1:]
    ends = np.concatenate([to_target, to_rest])
    times = np.arange(len(states)) * vehicle.control_step
    return np.stack([np.interp(ends, times, column) for column in np.array(states).T]), seconds


def directions(n: int) -> np.ndarray:
    """Return n unit vectors spread evenly over the sphere (Fibonacci), (n, 3)."""
    k = np.arange(n) + 0.5
    z = 1 - 2 * k / n
    radius = np.sqrt(1 - z**2)
    angle = np.pi * (1 + 5**0.5) * k
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def main() -> None:
    """Solve for each distance and direction, and print the means."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("vehicle", nargs="?", default="itm", help="name or YAML file (itm)")
    parser.add_argument(
        "--distances", type=float, nargs="+", default=[10.0, 20.0], help="m (10 20)"
    )
    parser.add_argument("--directions", type=int, default=12, help="targets at each distance (12)")
    options = parser.parse_args()
    vehicle = load_vehicle(options.vehicle)
    for distance in options.distances:
        targets = distance * directions(options.directions)
        times = np.array([least_time(vehicle, target) for target in targets])
        solved = times[np.isfinite(times)]
        print(
            f"{vehicle.name}, {distance:g} m: {solved.mean():.2f} s "
            f"({solved.min():.2f} to {solved.max():.2f}), "
            f"{solved.size} of {times.size} directions solved",
            flush=True,
        )


if __name__ == "__main__":
    main()
