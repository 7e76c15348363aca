"""``QuadcopterEnv``: one quadcopter on PyBullet as a Gymnasium environment."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.envs.bullet import BulletBody
from sb3_quad.envs.rendering import RENDER_MODES, Renderer
from sb3_quad.simulation.checks import check_options, check_size, vector
from sb3_quad.simulation.engine.rotors import NOT_FINITE, WORLD_FRAME_TOO, rotor_wrenches
from sb3_quad.simulation.engine.streams import STEP, new_streams, stream_key
from sb3_quad.simulation.observation import DEFAULT_MEAN, DEFAULT_STD, OBSERVATION_SIZE, observe
from sb3_quad.simulation.state import STATE_SIZE, TARGET, QuadcopterState
from sb3_quad.simulation.tasks import TaskSpec, reset_rows, resolve_tasks, score
from sb3_quad.vehicles.vehicle import Vehicle, load_vehicle

FloatArray = npt.NDArray[np.float64]
Observation = npt.NDArray[np.float32]
_ROW = np.zeros(1, dtype=np.int64)


class QuadcopterEnv(gymnasium.Env[Observation, npt.NDArray[np.float32]]):
    """
    ## Description

    A quadcopter with slow motors and a delayed command flies to a target and stays there. Two tasks are registered:

    | id | start | target |
    |----|-------|--------|
    | `QuadTargetTracking-v0` | hovering at (0, 0, 15) m | 10 m away in a uniformly random direction |
    | `QuadStateRecovery-v0` | at (0, 0, 15) m, thrown: any attitude, velocity and body rates at random | (0, 0, 15) m |

    The vehicle, the tasks and all numbers are those of the study thesis STUD-512; its equations are cited by number. The
    body is flown by PyBullet; :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv` flies many at once by compiled code, and
    its row `i` agrees with this environment reset with `seed + i` to 1e-9.

    The world frame has z up and the ground at z = 0. The body frame has x forward, y left, z up. Units are SI.

    ## Action Space

    `Box(-1, 1, (4,), float32)`: the commanded thrust of each rotor, as (0.5 a + 1) m g / 4 (Eq. 3.18; the limits are the
    vehicle's, and 0 the middle between them: hover for the default vehicle, `vehicle.hover_action` is it for any). Numbers
    outside [-1, 1] are clipped; ones that are not finite are refused.

    | Num | Rotor (default vehicle) | Min | Max | Thrust (N) |
    |-----|-------------------------|-----|-----|------------|
    | 0 | front left | -1 | 1 | 2.12 to 6.35 |
    | 1 | front right | -1 | 1 | 2.12 to 6.35 |
    | 2 | rear right | -1 | 1 | 2.12 to 6.35 |
    | 3 | rear left | -1 | 1 | 2.12 to 6.35 |

    A command acts one control step (0.01 s) after it was given; then the rotor speed follows it by Eq. 4.1.

    ## Observation Space

    `Box(-inf, inf, (18,), float32)`: each feature times `1 + noise * N(0, 1)`, drawn afresh every control step, then
    `(x - mean) / std` (Eq. 3.16; `std` as in Table A.2).

    | Num | Feature | Frame | Unit | std |
    |-----|---------|-------|------|-----|
    | 0-2 | position relative to the target, r - r_T | world | m | 10/√3 |
    | 3-11 | rotation matrix world to body, row by row | - | - | √3 |
    | 12-14 | linear velocity | body | m/s | 5 |
    | 15-17 | angular velocity | body | rad/s | 5 |

    ## Rewards

    Per control step, on the true state (Eqs. 4.5-4.9):
    `-0.003 |r - r_T| - 0.002 arccos(R33) - 0.0005 |ω|`, and -15 on touching the ground, -15 on getting out of range.

    ## Starting State

    As the table above says. State recovery: attitude uniform on SO(3), velocity N(0, 2 m/s) and body rates N(0, 4 rad/s)
    per axis. Rotors turn at hover speed, and hover is the command under way. `reset(options=...)` fixes a start:

    | Key | Meaning |
    |-----|---------|
    | `target` | r_T, (3,), world frame, m |
    | `state` | any of the four below; what is left out is drawn as ever |

    | Key of `state` | Meaning |
    |----------------|---------|
    | `position` | (3,), world frame, m; above the ground |
    | `quaternion` | (w, x, y, z), body to world; is normalised |
    | `velocity` | (3,), world frame, m/s |
    | `body_rates` | (3,), body frame, rad/s |

    The same seed and the same actions give the same episode, bit for bit.

    ## Episode End

    - *Terminated*: the collision sphere (radius 0.135 m) touches the ground, or |r - r_T| > 30 m.
    - *Truncated*: after 1500 control steps (15 s), by `max_episode_steps` of `gymnasium.make`.

    ## Info

    | Key | Meaning |
    |-----|---------|
    | `is_success` | not terminated so far; at the end of the episode, the thesis's success |
    | `distance` | from the target, m |
    | `collision` | the ground was touched |
    | `out_of_range` | too far from the target |

    ## Arguments

    ```python
    import gymnasium
    import sb3_quad

    env = gymnasium.make("QuadTargetTracking-v0", noise=0.0, task_kwargs={"target_distance": 15.0}, render_mode="rgb_array")
    ```

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | `task` | by id | a name, a :class:`~sb3_quad.simulation.tasks.Task`, or a mixture `{name: weight}` |
    | `task_kwargs` | `None` | fields of the task to override |
    | `vehicle` | `"itm"` | a name, the path of a YAML file, or a :class:`~sb3_quad.vehicles.vehicle.Vehicle` |
    | `noise` | 0.05 | relative standard deviation of the observation noise; 0: none |
    | `observation_mean`, `observation_std` | `None` | mean and std of Eq. 3.16, (18,) each; `None`: 0 and the table above |
    | `render_mode` | `None` | `"human"` (a real-time window, one per process), `"rgb_array"` (pictures, without a display) |
    | `render_width`, `render_height` | 640, 480 | size of pictures and window, pixels |

    ## While Flying

    On `env.unwrapped`; what is set holds until it is set anew, a target until the next reset.

    | Method | Sets |
    |--------|------|
    | `set_target(position)` | r_T, (3,), world frame, m |
    | `set_wrench(force, torque, force_frame, torque_frame)` | an external force (N) and torque (N m) at the centre of mass |
    | `set_noise(level)` | the relative standard deviation of the observation noise |
    | `set_observation_scaling(mean, std)` | mean and std of Eq. 3.16, (18,) each; `None` leaves one as it is |
    | `set_task(task, task_kwargs)` | the task from the next reset on |

    `true_state()`, `target`, `noise`, `observation_mean`, `observation_std` and `vehicle` tell what holds.

    ## Version History

    - v0: first version.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 100}

    def __init__(
        self,
        task: TaskSpec = "target_tracking",
        task_kwargs: Mapping[str, Any] | None = None,
        vehicle: str | Path | Vehicle = "itm",
        noise: float = 0.05,
        observation_mean: npt.ArrayLike | None = None,
        observation_std: npt.ArrayLike | None = None,
        render_mode: str | None = None,
        render_width: int = 640,
        render_height: int = 480,
    ) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ConfigError(unknown("render_mode", render_mode, RENDER_MODES))
        self._vehicle = load_vehicle(vehicle)
        self._tasks = self._next_tasks = resolve_tasks(task, task_kwargs)
        # Arrays of one vehicle for the functions that the batched environment uses, too.
        self._state = np.zeros((STATE_SIZE, 1))
        self._queue = np.zeros((self._vehicle.delay, 4, 1))
        self._wrench = np.zeros((12, 1))
        self._streams = np.zeros((4, 1), dtype=np.uint32)
        self._parameters = self._vehicle.parameters()[:, None].copy()
        self._task_index = np.zeros(1, dtype=np.int64)
        self._mean, self._std = DEFAULT_MEAN[:, None].copy(), DEFAULT_STD[:, None].copy()
        self._noise = np.zeros(1)
        self._wrenches = np.zeros((self._vehicle.substeps, 2, 3))
        self._reward, self._distance = np.zeros(1), np.zeros(1)
        self._collided, self._out_of_range = np.zeros(1, dtype=np.bool_), np.zeros(1, dtype=np.bool_)
        self._seeded = self._ready = False
        self.set_noise(noise)
        self.set_observation_scaling(observation_mean, observation_std)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = spaces.Box(-np.inf, np.inf, (OBSERVATION_SIZE,), np.float32)
        self.render_mode = render_mode
        if render_mode is not None:
            self.metadata = {**self.metadata, "render_fps": round(1.0 / self._vehicle.control_step)}
        check_size(render_width, render_height)
        self._size = render_width, render_height
        self._open()

    def _open(self) -> None:
        self._body = BulletBody(self._vehicle, self._size if self.render_mode == "human" else None)
        self._renderer = None
        if self._body.has_window or self.render_mode == "rgb_array":
            self._renderer = Renderer(self._vehicle, self._body, *self._size)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode; after :meth:`close`, in a new simulation.

        :param seed: begins a new stream of random numbers; None: the next episode of the present one.
        :param options: a fixed ``target`` and parts of the ``state``, as the class says.
        :raises ConfigError: an unknown option, or a value that is no start.
        """
        super().reset(seed=seed)
        fixed = check_options(options, self._vehicle)
        if seed is not None or not self._seeded:
            self._streams[:] = new_streams(np.array([stream_key(self.np_random)], dtype=np.uint64))
            self._seeded = True
        self._tasks = tasks = self._next_tasks
        state, parameters = self._state, self._parameters
        reset_rows(_ROW, state, self._queue, self._streams, self._task_index, parameters, tasks.parameters, tasks.weights)
        for rows, values in fixed:
            state[rows, 0] = values
        if not self._body.connected:
            self._open()
        self._body.place(state)
        self._ready = True
        self._distance[:] = self.true_state().distance
        self._collided[:] = self._out_of_range[:] = False  # only the end of a control step is judged
        if self._renderer is not None:
            self._renderer.reset(state)
            self._show()
        return self.observe(), self._info()

    def step(self, action: npt.NDArray[Any]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Fly one control step.

        :param action: (4,), clipped to [-1, 1].
        :raises ValueError: a wrong shape, or a number that is not finite.
        """
        array = np.asarray(action, dtype=np.float32)
        if array.shape != (4,):
            raise ValueError(f"action of shape {array.shape}: must be (4,), one number in [-1, 1] for each rotor")
        if not self._ready:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        body, state, wrench, parameters, wrenches = self._body, self._state, self._wrench, self._parameters, self._wrenches
        kind = rotor_wrenches(state, self._queue, array, wrench, parameters, self._vehicle.physics_step, wrenches)
        if kind == NOT_FINITE:
            raise ValueError(f"action {array.tolist()}: every number must be finite")
        if kind == WORLD_FRAME_TOO:
            body.fly_pushed(wrenches, wrench[0:3, 0], wrench[6:9, 0])
        else:
            body.fly(wrenches)
        body.read(state)
        self._streams[STEP, 0] += 1
        collided, out_of_range, tasks = self._collided, self._out_of_range, self._tasks.parameters
        score(state, parameters, self._task_index, tasks, self._reward, collided, out_of_range, self._distance)
        if self.render_mode == "human":
            self._show()
        info = self._info()
        return self.observe(), float(self._reward[0]), not info["is_success"], False, info

    def render(self) -> npt.NDArray[np.uint8] | None:
        """A picture, uint8 (height, width, 3), for ``"rgb_array"``; None for ``"human"``, whose window step() draws into."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() does nothing without a render_mode; pass render_mode='rgb_array' to make()")
        if self._renderer is None or self.render_mode == "human":
            return None
        return self._renderer.render(self._state, self._wrench)

    def _show(self) -> None:
        if self._renderer is not None and self.render_mode == "human":
            self._renderer.render(self._state, self._wrench)

    def close(self) -> None:
        """End the simulation; calling it twice is fine."""
        self._ready = False
        self._body.close()

    def true_state(self) -> QuadcopterState:
        """The true state, a live view of one row."""
        return QuadcopterState(self._state)

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle's parameters."""
        return self._vehicle

    @property
    def target(self) -> FloatArray:
        """r_T, (3,), world frame, m."""
        return self._state[TARGET, 0].copy()

    @property
    def noise(self) -> float:
        """Relative standard deviation of the observation noise."""
        return float(self._noise[0])

    @property
    def observation_mean(self) -> FloatArray:
        """μ of Eq. 3.16, (18,)."""
        return self._mean[:, 0].copy()

    @property
    def observation_std(self) -> FloatArray:
        """σ of Eq. 3.16, (18,)."""
        return self._std[:, 0].copy()

    def set_target(self, position: npt.ArrayLike) -> None:
        """Move the target, (3,), world frame, m; until the next reset."""
        self._state[TARGET, 0] = vector("target", position, 3)

    def set_wrench(
        self,
        force: npt.ArrayLike = (0.0, 0.0, 0.0),
        torque: npt.ArrayLike = (0.0, 0.0, 0.0),
        force_frame: str = "world",
        torque_frame: str = "body",
    ) -> None:
        """Apply an external force (N) and torque (N m), (3,) each, at the centre of mass until set anew.

        :param force_frame: ``"world"`` or ``"body"``, the axes of ``force``; ``torque_frame`` those of ``torque``.
        """
        wrench = np.zeros((4, 3))
        for number, (name, value, frame) in enumerate((("force", force, force_frame), ("torque", torque, torque_frame))):
            if frame not in ("world", "body"):
                raise ConfigError(f"{name}_frame {frame!r}: must be 'world' or 'body'")
            wrench[2 * number + (frame == "body")] = vector(name, value, 3)
        self._wrench[:, 0] = wrench.ravel()

    @property
    def wrench(self) -> FloatArray:
        """What :meth:`set_wrench` has set, (12,), a live view: force world, force body, torque world, torque body; N, N m."""
        return self._wrench[:, 0]

    def set_noise(self, level: float) -> None:
        """Set the relative standard deviation of the observation noise; 0: none."""
        value = vector("noise", np.atleast_1d(np.asarray(level)), 1)
        if value[0] < 0:
            raise ConfigError(f"noise {level!r}: must not be negative")
        self._noise[:] = value

    def set_observation_scaling(self, mean: npt.ArrayLike | None = None, std: npt.ArrayLike | None = None) -> None:
        """Set μ and σ of Eq. 3.16, (18,) each; None leaves one as it is."""
        new_mean = self.observation_mean if mean is None else vector("observation_mean", mean, OBSERVATION_SIZE)
        new_std = self.observation_std if std is None else vector("observation_std", std, OBSERVATION_SIZE)
        if (new_std <= 0).any():
            raise ConfigError("observation_std: every value must be positive")
        self._mean[:, 0], self._std[:, 0] = new_mean, new_std

    def set_task(self, task: TaskSpec, task_kwargs: Mapping[str, Any] | None = None) -> None:
        """Set the task of all episodes that begin from now on."""
        self._next_tasks = resolve_tasks(task, task_kwargs)

    def observe(self) -> Observation:
        """The present observation, (18,); the same numbers until the next step, unless something was set meanwhile."""
        observation = np.empty(OBSERVATION_SIZE, dtype=np.float32)
        observe(self._state, self._streams, self._mean, self._std, self._noise, observation[None])
        return observation

    def _info(self) -> dict[str, Any]:
        collision, out_of_range = bool(self._collided[0]), bool(self._out_of_range[0])
        return {
            "is_success": not (collision or out_of_range),
            "distance": float(self._distance[0]),
            "collision": collision,
            "out_of_range": out_of_range,
        }
