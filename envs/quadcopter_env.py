"""``QuadcopterEnv``: one quadcopter on PyBullet as a Gymnasium environment."""

import math
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt

from sb3_quad.base.arrays import Float32Array, FloatArray, Image
from sb3_quad.base.errors import ConfigError, unknown
from sb3_quad.envs.batch_env import INFOS, BatchEnv, quadcopter_spaces
from sb3_quad.envs.bullet import RENDER_MODES, BulletBody, Renderer
from sb3_quad.simulation.checks import check_size, per_row
from sb3_quad.simulation.settings import ENDLESS
from sb3_quad.simulation.state import BODY_RATES, POSITION, QUATERNION, TARGET, VELOCITY, P
from sb3_quad.simulation.tasks import TaskSpec
from sb3_quad.vehicles.vehicle import Vehicle

_START = {
    "position": POSITION,
    "quaternion": QUATERNION,
    "velocity": VELOCITY,
    "body_rates": BODY_RATES,
}


class QuadcopterEnv(BatchEnv, gymnasium.Env[Float32Array, Float32Array]):
    """
    ## Description

    A quadcopter with slow motors and a delayed command flies to a target and stays there. Two tasks
    are registered:

    | id | start | target |
    |----|-------|--------|
    | `QuadTargetTracking-v0` | hovering at (0, 0, 15) m | 10 m away in a uniformly random direction |
    | `QuadStateRecovery-v0` | at (0, 0, 15) m, thrown: any attitude, velocity and body rates at random | (0, 0, 15) m |

    The vehicle, the tasks and all numbers are those of the study thesis STUD-512; its equations are
    cited by number. The body is flown by PyBullet; :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv`
    flies many at once by compiled code, and each of its rows agrees with this environment reset
    with the row's seed to 1e-9.

    The world frame has z up and the ground at z = 0. The body frame has x forward, y left, z up.
    Units are SI.

    ## Action Space

    `Box(-1, 1, (4,), float32)`: the commanded thrust of each rotor, as (0.5 a + 1) m g / 4 (Eq.
    3.18; the limits are the vehicle's, and 0 the middle between them: hover for the default
    vehicle, `vehicle.hover_action` is it for any). Numbers outside [-1, 1] are clipped; ones that
    are not finite are refused.

    | Num | Rotor (default vehicle) | Min | Max | Thrust (N) |
    |-----|-------------------------|-----|-----|------------|
    | 0 | front left | -1 | 1 | 2.12 to 6.35 |
    | 1 | front right | -1 | 1 | 2.12 to 6.35 |
    | 2 | rear right | -1 | 1 | 2.12 to 6.35 |
    | 3 | rear left | -1 | 1 | 2.12 to 6.35 |

    A command acts one control step (0.01 s) after it was given; then the rotor speed follows it by
    Eq. 4.1.

    ## Observation Space

    `Box(-inf, inf, (18,), float32)`: each feature times `1 + noise * N(0, 1)`, sampled every
    control step, then `(x - mean) / std` (Eq. 3.16; `std` as in Table A.2). With `last_action`,
    `history` or `position_integral` it is made of frames of these, in all `batch.observation.size`
    numbers.

    | Num | Feature | Frame | Unit | std |
    |-----|---------|-------|------|-----|
    | 0-2 | position relative to the target, r - r_T | world | m | 10/√3 |
    | 3-11 | rotation matrix world to body, row by row | - | - | √3 |
    | 12-14 | linear velocity | body | m/s | 5 |
    | 15-17 | angular velocity | body | rad/s | 5 |

    ## Rewards

    Per control step, on the true state (Eqs. 4.5-4.9):
    `-0.003 |r - r_T| - 0.002 arccos(R33) - 0.0005 |ω|`, and -15 on touching the ground, -15 on
    getting out of range.

    ## Starting State

    As the table above says. State recovery: attitude uniform on SO(3), velocity N(0, 2 m/s) and
    body rates N(0, 4 rad/s) per axis. Rotors turn at hover speed, and hover is the command under
    way. `reset(options=...)` fixes a start:

    | Key | Meaning |
    |-----|---------|
    | `target` | r_T, (3,), world frame, m |
    | `state` | any of the four below; what is left out is sampled |

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

    An episode succeeds that is truncated within 0.1 m of the target; state recovery within 0.25 m,
    tilted by at most 10° (`success_distance` and `success_tilt` of the task).

    ## Info

    | Key | Meaning |
    |-----|---------|
    | `is_success` | close enough to the target now: at the end of the episode, whether it succeeded |
    | `survival` | not terminated so far: at the end of the episode, the thesis's success |
    | `distance` | from the target, m |
    | `collision` | the ground was touched |
    | `out_of_range` | too far from the target |

    ## Arguments

    ```python
    import gymnasium
    import sb3_quad

    env = gymnasium.make("QuadTargetTracking-v0", noise=0.0, task_kwargs={"target_distance": 15.0},
    render_mode="rgb_array") ```

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | `task` | by id | a name such as `"thesis_recovery"`, a :class:`~sb3_quad.simulation.tasks.Task`, or a mixture `{name: weight}` |
    | `task_kwargs` | `None` | fields of the task to override |
    | `vehicle` | `"itm"` | a name, the path of a YAML file, or a :class:`~sb3_quad.vehicles.vehicle.Vehicle` |
    | `rotor_layout` | `None` | a vehicle whose order of the rotors is kept: body axes and rotors of `vehicle` turn to it |
    | `noise` | 0.05 | relative std of the observation noise; or `{"relative": …, "additive": …}`, the second in σ |
    | `observation_mean`, `observation_std` | `None` | mean and std of Eq. 3.16, (18,) each; `None`: 0 and the table above |
    | `last_action` | `False` | whether a frame ends with the action before it, so that it has 22 numbers |
    | `history` | `None` | ages of the frames that are seen, control steps, such as `(0, 1, 2, 4)`; `None`: the present one |
    | `position_integral` | `None` | fields of :class:`~sb3_quad.simulation.frames.PositionIntegral`, `{}` for its own |
    | `vehicles` | `None` | a distribution of vehicles, one for each episode, such as `{"distribution": "raptor"}` |
    | `randomize` | `None` | fields of :class:`~sb3_quad.simulation.randomization.Randomization`: what differs by episode |
    | `render_mode` | `None` | `"human"` (a real-time window, one per process), `"rgb_array"` (pictures, without a display) |
    | `render_width`, `render_height` | 640, 480 | size of pictures and window, pixels |

    ## While Flying

    On `env.unwrapped`; what is set holds until it is set anew, a target until the next reset.

    | Method | Sets |
    |--------|------|
    | `set_target(position)` | r_T, (3,), world frame, m |
    | `set_wrench(force, torque, force_frame, torque_frame)` | an external force (N) and torque (N m) at the centre of mass; |
    | | where `randomize` has some, the next episode brings its own |
    | `set_wind(velocity)` | the velocity of the air, (3,), world frame, m/s; it acts on vehicles with `drag` |
    | `set_noise(level)` | the relative standard deviation of the observation noise |

    `true_state()`, `target`, `wrench`, `wind`, `noise`, `observation_mean`, `observation_std`,
    `task`, `task_kwargs` and `vehicle` tell what holds.

    ## Version History

    - v0: first version.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 100}

    def __init__(
        self,
        task: TaskSpec = "target_tracking",
        task_kwargs: Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        render_width: int = 640,
        render_height: int = 480,
        seed: int | None = None,
        **keywords: Any,
    ) -> None:
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ConfigError(unknown("render_mode", render_mode, RENDER_MODES))
        check_size(render_width, render_height)
        # One row of the batched environment, whose body PyBullet moves; Gymnasium's TimeLimit
        # truncates.
        if (steps := keywords.setdefault("max_episode_steps", ENDLESS)) != ENDLESS:
            raise ConfigError(
                f"max_episode_steps {steps}: give it to gymnasium.make, whose TimeLimit truncates"
            )
        self._make_batch(
            1, seed, n_threads=1, autoreset=False, task=task, task_kwargs=task_kwargs, **keywords
        )
        self._ready = False
        self.observation_space, self.action_space = quadcopter_spaces(self.batch.observation.size)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.vehicle.control_step)}
        self._size = render_width, render_height
        self._open()

    def _open(self) -> None:
        self._body = BulletBody(self.vehicle, self._size if self.render_mode == "human" else None)
        self._body.become(self.batch.vehicles[:, 0])
        self._renderer = None
        if self._body.has_window or self.render_mode == "rgb_array":
            self._renderer = Renderer(self.vehicle, *self._size, self._body)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Begin an episode; after :meth:`close`, in a new simulation.

        :param seed: begins a new stream of random numbers; None: the next episode of the present
            one.
        :param options: a fixed ``target`` and parts of the ``state``, as the class says.
        :raises ConfigError: an unknown option, or a value that is no start.
        """
        super().reset(seed=seed)
        fixed = _fixed_rows(options, self.vehicle)
        batch = self.batch
        if seed is not None:
            batch.seed([seed])
        batch.reset()
        for rows, values in fixed:
            batch.state[rows, 0] = values
        if not self._body.connected:
            self._open()
        self._body.become(batch.vehicles[:, 0])
        self._body.place(self.true_state())
        self._ready = True
        if self._renderer is not None:
            self._renderer.reset(batch.state[:, 0])
        if self.render_mode == "human":
            self._draw()
        batch.clear_outcome()
        return self.observe(), self._info()

    def step(
        self, action: npt.NDArray[Any]
    ) -> tuple[Float32Array, float, bool, bool, dict[str, Any]]:
        """Fly one control step.

        :param action: (4,), clipped to [-1, 1].
        :raises ValueError: a wrong shape, or a number that is not finite.
        """
        array = np.asarray(action, dtype=np.float32)
        if array.shape != (4,):
            raise ValueError(
                f"action of shape {array.shape}: must be (4,), one number in [-1, 1] for each rotor"
            )
        if not self._ready:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        if not math.isfinite(sum(array.tolist())):
            raise ValueError(f"action {array.tolist()}: every number must be finite")
        batch = self.batch
        drag = batch.vehicles[P.drag_x : P.drag_z + 1, 0] if batch.has_drag else None
        self._body.fly(
            batch.turn_rotors(array[None]),
            batch.total_wrench()[:, 0],
            drag,
            batch.total_wind()[:, 0],
        )
        self._body.read(batch.state)
        observations, _, _ = batch.score(array[None])
        if self.render_mode == "human":
            self._draw()
        info = self._info()
        return observations[0], float(batch.outcome["reward"][0]), not info["survival"], False, info

    def _info(self) -> dict[str, Any]:
        ended = dict(
            zip(self.batch.outcome.dtype.names or (), self.batch.outcome[0].item(), strict=True)
        )
        return {key: ended[field] for key, field in INFOS.items()}

    def render(self) -> Image | None:
        """A picture, uint8 (height, width, 3), for ``"rgb_array"``; None for ``"human"``, whose
        window step() draws into.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() does nothing without a render_mode; pass render_mode='rgb_array' to make()"
            )
        return self._draw() if self.render_mode == "rgb_array" else None

    def _draw(self) -> Image | None:
        return (
            None
            if self._renderer is None
            else self._renderer.render(self.batch.state[:, 0], self.wrench)
        )

    def close(self) -> None:
        """End the simulation; calling it twice is fine."""
        self._ready = False
        self._body.close()

    def observe(self) -> Float32Array:
        """The present observation, (18,); the same numbers until the next step, unless something
        was set meanwhile.
        """
        return np.asarray(self.batch.observe()[0])

    @property
    def wrench(self) -> FloatArray:
        """Set or sampled, without gusts, (12,), a live view: force world, force body, torque world,
        torque body; N, N m.
        """
        return self.batch.wrench[:, 0]

    def _by_row(self, columns: FloatArray) -> FloatArray:
        return np.asarray(super()._by_row(columns)[0])


def _fixed_rows(
    options: Mapping[str, Any] | None, vehicle: Vehicle
) -> list[tuple[slice, FloatArray]]:
    """The rows of the state that ``options`` of a reset fix, and their values."""
    given = dict(options or {})
    start = given.pop("state", None) or {}
    if not isinstance(start, Mapping):
        raise ConfigError(f"options: state {start!r}: must hold some of {', '.join(_START)}")
    for parts, known in ((given, ("target", "state")), (start, _START)):
        for key in parts:
            if key not in known:
                raise ConfigError(f"options: {unknown('key', key, known)}")
    fixed = []
    for name, rows in {"target": TARGET, **_START}.items():
        value = (given if name == "target" else start).get(name)
        if value is None:
            continue
        values = per_row(f"options: {name}", value, 1, rows.stop - rows.start)[:, 0]
        if name == "position" and values[2] <= vehicle.collision_radius:
            raise ConfigError(
                f"position {values.tolist()}: touches the ground; z must exceed {vehicle.collision_radius} m"
            )
        if name == "quaternion":
            if np.linalg.norm(values) < 1e-6:
                raise ConfigError("options: quaternion: must not be zero")
            values = values / np.linalg.norm(values)
        fixed.append((rows, values))
    return fixed
