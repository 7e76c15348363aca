# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Your own expert and reward
#
# The experts of the package hurry. Suppose your quadcopter carries a cup of coffee, so it should
# fly slowly and hardly tilt. You can say so in two ways: by example, with an expert of your own, or
# by a price, with a reward of your own.

# %%
import matplotlib.pyplot as plt
import numpy as np
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_quad import PPOBC, DAgger, GeometricExpert, load_pretrained, pretrained_path
from sb3_quad.agents.transfer import transfer_policy
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.envs.simulation.state import TARGET, QuadcopterState
from sb3_quad.evaluation.flightlog import Recorder
from sb3_quad.evaluation.flights import fly
from sb3_quad.evaluation.plots import STYLE
from sb3_quad.evaluation.tables import colours_of
from sb3_quad.experts.protocol import Expert

plt.rcParams.update({**STYLE, "figure.constrained_layout.use": True, "figure.dpi": 110})

# %% tags=["parameters"]
EPISODES = 240  # episodes of each comparison
IMITATION = 900_000  # timesteps that the agent imitates
REINFORCEMENT = 600_000  # timesteps that another learns from the reward

# %% [markdown]
# ## An expert
#
# Your expert needs one method, `actions(state)`. It gets the true state of n vehicles and returns n
# rows of four rotor thrusts in [-1, 1]. Here the geometric controller of the package does the work.
# You only show it a target close ahead, and the nearer that target is, the slower it flies.


# %%
class UnhurriedExpert(Expert):
    """Flies to a point at most ``reach`` metres ahead on the way to the target."""

    def __init__(self, vehicle="itm", reach=0.6):
        super().__init__(vehicle)
        self.reach = reach
        self.controller = GeometricExpert(vehicle)

    def actions(self, state):
        """Float32 (n, 4), for the true state of n vehicles."""
        way = state.target - state.position
        share = np.minimum(1.0, self.reach / np.maximum(state.distance, 1e-9))
        near = state.array.copy()
        near[TARGET] = (state.position + share[:, None] * way).T
        return self.controller.actions(QuadcopterState(near))


# %% [markdown]
# ## Does it do what you want
#
# Look at its flights before you train on it. `fly` takes anything that flies: experts, models of
# Stable-Baselines3, functions.


# %%
def recorded(controller, n=24, seed=7):
    """Trajectories of n flights to targets 10 m away."""
    recorder = Recorder(n)
    fly(controller, "target_tracking", n_episodes=n, seed=seed, hooks=[recorder])
    return recorder.arrays()


# %% tags=["hide-input"]
def plot_flights(controllers):
    """Plot distance, speed and tilt over time: the median, and the range of nine flights in ten."""
    _, panels = plt.subplots(1, 3, figsize=(11, 3.2))
    colours = colours_of([*controllers])
    for name, controller in controllers.items():
        colour = colours[name]
        flights = recorded(controller)
        times = flights["time"]
        _, x, y, _ = np.moveaxis(flights["quaternion"], -1, 0)
        distance = np.linalg.norm(flights["position"] - flights["target"], axis=-1)
        speed = np.linalg.norm(flights["velocity"], axis=-1)
        tilt = np.degrees(np.arccos(np.clip(1 - 2 * (x**2 + y**2), -1, 1)))
        for panel, values in zip(panels, (distance, speed, tilt), strict=True):
            low, middle, high = np.nanpercentile(values, [5, 50, 95], axis=0)
            panel.fill_between(times, low, high, color=colour, alpha=0.15, linewidth=0)
            panel.plot(times, middle, color=colour, label=name)
    labels = ("distance from the target (m)", "speed (m/s)", "tilt (deg)")
    for panel, label in zip(panels, labels, strict=True):
        panel.set(xlabel="time (s)", ylabel=label, xlim=(0, 15), ylim=(0, None))
    panels[0].legend()
    plt.show()


# %%
expert = UnhurriedExpert()
plot_flights({"geometric expert": GeometricExpert(), "unhurried expert": expert})

# %% [markdown]
# ## An agent that imitates it
#
# Your expert sees the true state, your agent only 18 noisy features. `beta` is the probability with
# which the expert flies a control step itself: 1 in the first rollout, less in each later one.

# %%
agent = DAgger(
    "MlpPolicy",
    QuadcopterVecEnv(240, task="target_tracking", seed=0),
    expert=expert,
    n_steps=125,
    batch_size=2048,
    gradient_steps=100,
    n_epochs=1,
    gamma=0.99,
    learning_rate=LinearSchedule(5e-3, 2.5e-4, 1.0),
    beta=1.0,
    beta_decay=0.2,
    beta_final=0.0,
    seed=0,
    device="cpu",
)
agent.learn(IMITATION)
agent.save("unhurried")
plot_flights({"geometric expert": GeometricExpert(), "unhurried expert": expert, "agent": agent})

# %% [markdown]
# ## A reward
#
# You can change the coefficients of the task's reward by name:
# `task_kwargs={"tilt_cost": 0.004}` doubles the thesis's price of a tilt. For anything else you
# write a wrapper. This one charges for restless rotors, which spill coffee, too.


# %%
class CalmActions(VecEnvWrapper):
    """Subtract ``cost`` times the mean squared change of the action from each reward."""

    changes = ""  # neither observations nor actions

    def __init__(self, venv, cost):
        super().__init__(venv)
        self.cost = cost

    def reset(self):
        """Begin a new episode in every row, after an action of hover."""
        self.last = np.zeros((self.num_envs, *self.action_space.shape), dtype=np.float32)
        return self.venv.reset()

    def step_async(self, actions):
        """Remember how much the action changes."""
        self.change = np.square(actions - self.last).mean(axis=1)
        self.last = actions.copy()
        self.venv.step_async(actions)

    def step_wait(self):
        """Return the environment's reward less the cost."""
        observations, rewards, dones, infos = self.venv.step_wait()
        rewards = rewards - self.cost * self.change.astype(np.float32)
        # Rows that are done begin their next episode, after an action of hover.
        self.last[dones] = 0.0
        return observations, rewards, dones, infos


# %% [markdown]
# `itm-imitation` comes with the package and was trained without that price. `PPOBC` continues from
# it: PPO, with a cloning term that keeps the policy near an expert.


# %%
def make_env(n_envs, seed):
    """Flights to targets 10 m away, where tilts and restless rotors cost more."""
    env = QuadcopterVecEnv(
        n_envs,
        "target_tracking",
        task_kwargs={"tilt_cost": 0.004},
        max_episode_steps=500,
        seed=seed,
    )
    return CalmActions(env, cost=2.0)


calm = PPOBC(
    "MlpPolicy",
    make_env(240, seed=0),
    expert=GeometricExpert(),
    bc_coef=5.0,
    bc_loss="huber_mse",
    bc_filter="none",
    n_steps=125,
    batch_size=5000,
    n_epochs=6,
    gamma=0.99,
    gae_lambda=0.98,
    critic_warmup=2,
    learning_rate=LinearSchedule(3e-4, 1.5e-5, 1.0),
    policy_kwargs={"log_std_init": -2.6},
    seed=0,
    device="cpu",
)
transfer_policy(pretrained_path("itm-imitation"), calm)  # policy and critic
calm.learn(REINFORCEMENT)
calm.save("calm")

# %% [markdown]
# Compare the new reward on fresh flights, before and after. The plot shows where it comes from: the
# squared change of the action over time.


# %%
def mean_reward(controller):
    """Mean reward of the first 5 s of fresh flights."""
    env = make_env(EPISODES, seed=1_000_000)
    observations = env.reset()
    total = np.zeros(EPISODES)
    for _ in range(500):
        actions, _ = controller.predict(observations, deterministic=True)
        observations, rewards, _, _ = env.step(actions)
        total += rewards
    return total.mean()


_, axes = plt.subplots(figsize=(7, 3.2))
before_and_after = {"before": load_pretrained("itm-imitation"), "after": calm}
colours = colours_of([*before_and_after])
for name, controller in before_and_after.items():
    flights = recorded(controller, n=EPISODES, seed=1_000_000)
    change = np.square(np.diff(flights["action"], axis=1)).mean(axis=(0, 2))
    print(
        f"{name:6} mean reward {mean_reward(controller):6.2f}, "
        f"mean squared change {np.nanmean(change):.6f}"
    )
    axes.semilogy(flights["time"][1:], change, color=colours[name], label=name)
axes.set(
    xlabel="time (s)",
    ylabel="mean squared change",
    xlim=(0, 5),
    title="How restless the rotors are",
)
axes.yaxis.set_major_formatter("{x:g}")
axes.legend()
plt.show()

# %% [markdown]
# Your cost is quadratic. So the large changes on the way became smaller. The small ones at the
# target cost little, and they stayed about as they were.
#
# ## Further
#
# Put your expert into a module, `my_module.py`, and you can use it in every command:
#
# - `sb3-quad train --algo dagger --expert my_module:UnhurriedExpert`
# - `sb3-quad evaluate pid my_module:UnhurriedExpert`
#
# On the command line you give coefficients of the reward with `--env-kwargs
# "task_kwargs:dict(tilt_cost=0.004)"`.
