"""``QuadcopterEnv``: one quadcopter on PyBullet as a Gymnasium environment."""

import math
import sys
from functools import partial

import gymnasium
import numpy as np
from typing_extensions import Unpack

from sb3_quad.base.errors import ConfigError, refuse_unknown
from sb3_quad.base.types import AnyArray, Float32Array, FloatArray, Image, StrDict, StrMapping
from sb3_quad.base.validate import Frozen, validate
from sb3_quad.envs.batch_env import (
    INFOS,
    BatchEnv,
    FlightKeywords,
    Quaternion,
    Vector,
    quadcopter_spaces,
)
from sb3_quad.envs.bullet import RENDER_MODES, BulletBody, Renderer
from sb3_quad.envs.rendering.window import FPS, Window, has_display
from sb3_quad.envs.simulation.checks import check_size
from sb3_quad.envs.simulation.settings import ENDLESS
from sb3_quad.envs.simulation.state import POSITION, P
from sb3_quad.envs.simulation.tasks import TaskSpec


class _Start(Frozen):
    """Parts of the state that a reset can fix, besides the target."""

    position: Vector | None = None
    quaternion: Quaternion | None = None
    velocity: Vector | None = None
    body_rates: Vector | None = None


class _ResetOptions(Frozen):
    """The options of a reset."""

    target: Vector | None = None
    state: _Start | None = None


class QuadcopterEnv(BatchEnv, gymnasium.Env[Float32Array, Float32Array]):
    """
    ## Description

    A quadcopter flies to a target and stays there. Its motors are slow, and a command acts only
    after a delay. Two tasks are registered:

    | id | start at (0, 0, 15) m | target |
    |----|-----------------------|--------|
    | `QuadTargetTracking-v0` | hovering | 10 m away in a uniformly random direction |
    | `QuadStateRecovery-v0` | thrown: random attitude, velocity and body rates | (0, 0, 15) m |

    The vehicle, the tasks and all numbers are those of the study thesis STUD-512; its equations are
    cited by number. PyBullet moves the body. To fly many vehicles at once, use
    :class:`~sb3_quad.envs.vec_env.QuadcopterVecEnv`, which is compiled code. If you reset this
    environment with a row's seed, it flies as that row does, to 1e-9.

    The world frame has z up and the ground at z = 0. The body frame has x forward, y left, z up.
    Units are SI.

    ## Action Space

    `Box(-1, 1, (4,), float32)`: the commanded thrust of each rotor, (0.5 a + 1) m g / 4 for the
    default vehicle (Eq. 3.18). In general -1 and 1 are the vehicle's thrust limits, and 0 is the
    middle between them. The default vehicle hovers at 0; others hover at `vehicle.hover_action`.
    Numbers outside [-1, 1] are clipped. Numbers that are not finite raise an error.

    | Num | Rotor (default vehicle) | Min | Max | Thrust (N) |
    |-----|-------------------------|-----|-----|------------|
    | 0 | front left | -1 | 1 | 2.12 to 6.35 |
    | 1 | front right | -1 | 1 | 2.12 to 6.35 |
    | 2 | rear right | -1 | 1 | 2.12 to 6.35 |
    | 3 | rear left | -1 | 1 | 2.12 to 6.35 |

    With `action="rates"`, action 0 commands the collective thrust, four times a rotor's, and 1 to 3
    the body rates in roll, pitch and yaw, up to the `limits` of the vehicle's
    :class:`~sb3_quad.envs.vehicles.rates.RateLoop`, which holds them.

    A command acts one control step (0.01 s) after you give it. Then the rotor speed follows it (Eq.
    4.1).

    ## Observation Space

    `Box(-inf, inf, (18,), float32)`: each feature times `1 + noise * N(0, 1)`, sampled every
    control step, then `(x - mean) / std` (Eq. 3.16; `std` as in Table A.2). With `last_action`,
    `history` or `position_integral` the observation consists of frames built from these features,
    with `batch.observation.size` numbers in all.

    | Num | Feature | Frame | Unit | std |
    |-----|---------|-------|------|-----|
    | 0-2 | position relative to the target, r - r_T | world | m | 10/√3 |
    | 3-11 | rotation matrix world to body, row by row | - | - | √3 |
    | 12-14 | linear velocity | body | m/s | 5 |
    | 15-17 | angular velocity | body | rad/s | 5 |


    ## Rewards

    Per control step, on the true state (Eqs. 4.5-4.9):
    `-0.003 |r - r_T| - 0.002 arccos(R33) - 0.0005 |ω|`. Touching the ground costs 15 more, and so
    does flying out of range.

    ## Starting State

    See the first table. In state recovery the attitude is uniform on SO(3), and each component of
    the velocity is normal with σ = 2 m/s, each of the body rates with σ = 4 rad/s. The rotors turn
    at hover speed, and the delayed command is hover. You can fix a start by `reset(options=...)`:

    | Key | Meaning |
    |-----|---------|
    | `target` | r_T, (3,), world frame, m |
    | `state` | any of the four below; the others are sampled |

    | Key of `state` | Meaning |
    |----------------|---------|
    | `position` | (3,), world frame, m; above the ground |
    | `quaternion` | (w, x, y, z), body to world; it is normalised |
    | `velocity` | (3,), world frame, m/s |
    | `body_rates` | (3,), body frame, rad/s |

    The same seed and the same actions give the same episode, bit for bit.

    ## Episode End

    - *Terminated*: the collision sphere (radius 0.135 m) touches the ground, or |r - r_T| > 30 m.
    - *Truncated*: after 1500 control steps (15 s), by `max_episode_steps` of `gymnasium.make`.

    An episode succeeds if it is truncated within 0.1 m of the target. State recovery succeeds
    within 0.25 m, tilted by at most 10° (`success_distance` and `success_tilt` of the task).

    ## Info

    | Key | Meaning |
    |-----|---------|
    | `is_success` | whether it is close enough now; at the end, whether the episode succeeded |
    | `survival` | whether it has not terminated so far; at the end, the thesis's success |
    | `distance` | distance from the target, m |
    | `collision` | whether it touched the ground, other than by landing |
    | `out_of_range` | whether it is too far from the target |

    ## Arguments

    ```python
    import gymnasium
    import sb3_quad

    env = gymnasium.make(
        "QuadTargetTracking-v0",
        noise=0.0,
        task_kwargs={"target_distance": 15.0},
        render_mode="rgb_array",
    )
    ```

    | Argument | Default | Meaning |
    |----------|---------|---------|
    | `task` | by id | a name such as `"thesis_recovery"`, a `Task`, or a mixture `{name: weight}` |
    | `task_kwargs` | `None` | fields of the task to override |
    | `vehicle` | `"itm"` | a name, the path of a YAML file, or a `Vehicle` |
    | `rotor_layout` | `None` | the vehicle whose axes and rotor order the agent knows |
    | `action` | `"thrusts"` | `"rates"`: actions command collective thrust and body rates |
    | `noise` | 0.05 | relative std of the observation noise, or the fields of `Noise` |
    | `observation_mean` | `None` | mean of Eq. 3.16, (18,); `None`: zero |
    | `observation_std` | `None` | std of Eq. 3.16, (18,); `None`: the table above |
    | `last_action` | `False` | whether a frame ends with the action before it (22 numbers) |
    | `history` | `None` | ages of the observed frames in control steps, such as `(0, 1, 2, 4)` |
    | `position_integral` | `None` | fields of `PositionIntegral`; `{}`: its defaults |
    | `vehicles` | `None` | fields of `VehicleDistribution`: each episode has another vehicle |
    | `randomize` | `None` | fields of `Randomization`: what is sampled per episode |
    | `reference` | `None` | a curve that the target flies, such as `"figure_eight"` |
    | `wrench` | `None` | a log's force and torque: CSV file, t,fx,fy,fz[,tx,ty,tz] |
    | `wind` | `None` | a log's velocity of the air: CSV file, t,vx,vy,vz |
    | `preview` | `None` | control steps ahead whose acceleration of the reference is observed |
    | `render_mode` | `None` | `"human"` or `"rgb_array"` |
    | `render_width` | 640 | width of pictures and window, pixels |
    | `render_height` | 480 | height of pictures and window, pixels |

    If you give a `rotor_layout`, the body axes and rotors of `vehicle` are turned to it, so that an
    agent of one vehicle can fly another. `noise={"relative": 0.05, "additive": 0.02}` adds noise in
    units of std, and its field `estimator` the errors of a state estimator. `history=None` means
    the current frame alone. To sample vehicles from a named distribution, give
    `vehicles={"distribution": "raptor"}`. A `reference` is the name of a curve,
    fields of `Reference`, the path of a CSV file or a function of time; it begins at the episode's
    target. Render mode `"human"` shows
    the pictures of `"rgb_array"` in a real-time window; the latter needs no display.

    The classes are :class:`~sb3_quad.envs.simulation.tasks.Task`,
    :class:`~sb3_quad.envs.vehicles.vehicle.Vehicle`,
    :class:`~sb3_quad.envs.simulation.settings.Noise`,
    :class:`~sb3_quad.envs.simulation.estimator.EstimatorError`,
    :class:`~sb3_quad.envs.simulation.recordings.Recording`,
    :class:`~sb3_quad.envs.simulation.frames.PositionIntegral`,
    :class:`~sb3_quad.envs.simulation.vehicle_distribution.VehicleDistribution`,
    :class:`~sb3_quad.envs.simulation.randomization.Randomization` and
    :class:`~sb3_quad.envs.simulation.references.Reference`.

    ## While Flying

    Call these methods on `env.unwrapped`. A setting lasts until you set it again; a target or
    reference lasts until the next reset.

    | Method | Sets |
    |--------|------|
    | `set_target(position)` | r_T, (3,), world frame, m |
    | `set_reference(position, …)` | r_T, its velocity and acceleration, and a heading, rad |
    | `set_wrench(force, torque, …)` | an external force, N, and torque, N m, at the mass centre |
    | `set_wind(velocity)` | the velocity of the air, (3,), world frame, m/s |
    | `set_noise(level)` | the relative standard deviation of the observation noise |

    Force and torque act in the frames `force_frame="world"` and `torque_frame="body"` unless you
    give others. If `randomize` samples them or a wind, the next episode replaces yours. Wind acts
    on vehicles with `drag`.

    `true_state()`, `estimated_state()`, `target`, `wrench`, `wind`, `noise`, `observation_mean`,
    `observation_std`, `task`, `task_kwargs` and `vehicle` return the current values.

    ## Version History

    - v0: first version.
    """

    metadata: StrDict = {"render_modes": list(RENDER_MODES), "render_fps": 100}

    def __init__(
        self,
        task: TaskSpec = "target_tracking",
        *,
        render_mode: str | None = None,
        render_width: int = 640,
        render_height: int = 480,
        seed: int | None = None,
        **keywords: Unpack[FlightKeywords],
    ) -> None:
        if render_mode is not None:
            refuse_unknown("render_mode", [render_mode], RENDER_MODES)
        check_size(render_width, render_height)
        # Gymnasium's TimeLimit truncates, so the batch must not.
        steps = keywords.setdefault("max_episode_steps", ENDLESS)
        if steps != ENDLESS:
            raise ConfigError(
                f"max_episode_steps {steps}: give it to gymnasium.make, whose TimeLimit truncates"
            )
        # One row of the batched environment. PyBullet moves its body.
        self._make_batch(1, seed, 1, task, autoreset=False, **keywords)
        self.observation_space, self.action_space = quadcopter_spaces(self.batch.observation.size)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.vehicle.control_step)}
        self._size = (render_width, render_height)
        self._open()

    def _open(self) -> None:
        """Begin a simulation, with a window or pictures if the render mode asks for them. Without a
        display no window opens, and a line on stderr says why.
        """
        self._body = BulletBody(self.vehicle)
        self._renderer = Renderer(self.vehicle, *self._size)
        self._window = None
        if self.render_mode != "human":
            return
        if has_display():
            self._window = Window(*self._size)
            self._frames_due = 1.0  # the first one at once
        else:
            sys.stderr.write(
                "sb3_quad: DISPLAY is not set, so no window opens; "
                "render_mode='rgb_array' makes pictures\n"
            )

    def __getstate__(self) -> StrDict:
        """Return all but the simulation, which PyBullet can neither copy nor save."""
        return {**vars(self), "_body": None, "_window": None}

    def __setstate__(self, state: StrDict) -> None:
        """Resume the flight in a new simulation."""
        vars(self).update(state)
        self._open()
        if self._has_begun:
            self._place()

    def _place(self) -> None:
        """Put the body where the batch says, and begin to draw there."""
        # Each episode may have another vehicle.
        self._body.become(self.batch.vehicles[:, 0])
        self._body.place(self.true_state())
        self._renderer.reset(self.batch.state[:, 0])

    def reset(
        self, *, seed: int | None = None, options: StrDict | None = None
    ) -> tuple[Float32Array, StrDict]:
        """Begin an episode; after :meth:`close`, in a new simulation.

        :param seed: begins a new stream of random numbers. None: continue with the current one.
        :param options: a fixed ``target`` and parts of the ``state``, see the class.
        :raises ConfigError: an unknown option, or a value that does not fit.
        """
        super().reset(seed=seed)
        # Check the options before anything changes.
        fixed = _fixed_parts(options or {})
        batch = self.batch
        if seed is not None:
            batch.seed([seed])
        # What follows may raise, and the body is not yet where the batch is.
        self._has_begun = False
        batch.reset()
        for name, values in fixed:
            batch.fix(name, values[:, None])
        radius = batch.vehicles[P.collision_radius, 0]
        position = batch.state[POSITION, 0]
        if position[2] <= radius:
            raise ConfigError(
                f"position {position.tolist()}: touches the ground; z must exceed {radius:g} m"
            )
        if not self._body.connected:
            self._open()
        self._place()
        self._has_begun = True
        self._show()
        # The outcome that an info shows is that of the new episode.
        batch.clear_outcome()
        return self.observe(), self._info()

    def step(self, action: AnyArray) -> tuple[Float32Array, float, bool, bool, StrDict]:
        """Fly one control step.

        :param action: (4,), clipped to [-1, 1].
        :raises ValueError: a wrong shape, or a number that is not finite.
        """
        array = np.asarray(action, np.float32)
        if array.shape != (4,):
            raise ValueError(
                f"action of shape {array.shape}: must be (4,), one number in [-1, 1] for each rotor"
            )
        if not self._has_begun:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        # The sum is finite only if all numbers are; this is faster than NumPy for four of them.
        if not math.isfinite(sum(array.tolist())):
            raise ValueError(f"action {array.tolist()}: every number must be finite")

        # The batch turns the rotors and scores the step; in between, PyBullet moves the body.
        batch = self.batch
        wrench = batch.total_wrench()[:, 0]
        for rotors, speeds in batch.turn_rotors(array[None]):
            air = partial(batch.air_on, rotors, speeds) if batch.feels_air else None
            self._body.fly(rotors, wrench, air)
            self._body.read(batch.state)
        observations, _, _ = batch.score(array[None])
        self._show()
        info = self._info()
        return observations[0], float(batch.outcome["reward"][0]), not info["survival"], False, info

    def _info(self) -> StrDict:
        outcome = self.batch.outcome[0]
        return {key: outcome[field].item() for key, field in INFOS.items()}

    def render(self) -> Image | None:
        """Return a picture, uint8 (height, width, 3), in render mode ``"rgb_array"``.

        In ``"human"`` return None: step() draws into the window.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(
                "render() does nothing without a render_mode; "
                "pass render_mode='rgb_array' to make()"
            )
        return self._draw() if self.render_mode == "rgb_array" else None

    def _draw(self) -> Image:
        return self._renderer.render(self.batch.state[:, 0])

    def _show(self) -> None:
        """Draw into the window, if there is one and its next picture is due."""
        if self._window is None or not self._window.is_open:
            return
        self._frames_due += FPS * self.vehicle.control_step
        if self._frames_due >= 1.0:
            self._frames_due %= 1.0
            self._window.show(self._draw(), 1.0 / FPS)

    def close(self) -> None:
        """End the simulation; calling it twice is fine."""
        self._has_begun = False
        self._body.close()
        if self._window is not None:
            self._window.close()

    def observe(self) -> Float32Array:
        """Return the current observation, (observation size,).

        The numbers stay the same until the next step, unless you set something in between.
        """
        return np.asarray(self.batch.observe()[0])

    def _by_row(self, columns: FloatArray) -> FloatArray:
        return np.asarray(super()._by_row(columns)[0])


def _fixed_parts(options: StrMapping) -> list[tuple[str, FloatArray]]:
    """Return the quantities of the state that the options of a reset fix, with their values."""
    given = validate(_ResetOptions, options, "options")
    fixed = []
    for name, value in [*(given.state or _Start()), ("target", given.target)]:
        if value is None:
            continue
        values = np.array(value)
        if name == "quaternion":
            values = values / np.linalg.norm(values)
        fixed.append((name, values))
    return fixed
