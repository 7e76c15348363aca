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
# # Fly and train in five minutes
#
# First you fly an agent that comes with the package. Then you train one of your own: it imitates a
# PID controller, and PPO takes it further than its expert. Everything runs on one core of a CPU.

# %%
import matplotlib.pyplot as plt
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import LinearSchedule

from sb3_quad import PPOBC, DAgger, PIDExpert, load_pretrained
from sb3_quad.agents.transfer import transfer_policy
from sb3_quad.envs import QuadcopterVecEnv
from sb3_quad.evaluation.flightlog import Recorder
from sb3_quad.evaluation.flights import fly
from sb3_quad.evaluation.offset_correction import correct_offset
from sb3_quad.evaluation.plots import STYLE
from sb3_quad.evaluation.tables import COLOURS, colours_of

plt.rcParams.update({**STYLE, "figure.constrained_layout.use": True, "figure.dpi": 110})

# %% tags=["parameters"]
EPISODES = 480  # episodes of each comparison
IMITATION = 600_000  # timesteps of DAgger
REINFORCEMENT = 3_000_000  # timesteps of PPO

# %% [markdown]
# ## Fly
#
# In a *state recovery* you let the quadcopter go in any attitude, upside down included, with random
# velocity and body rates. The controller has to level it and bring it back to where you let it go.
# `fly` flies as many episodes as you want, side by side. With the same seed you give every
# controller the same starts. A `Recorder` keeps the trajectories.


# %%
def recorded(controller, n=24, seed=7):
    """Trajectories of n recoveries."""
    recorder = Recorder(n)
    fly(
        controller,
        "state_recovery",
        n_episodes=n,
        seed=seed,
        max_episode_steps=600,
        hooks=[recorder],
    )
    return recorder.arrays()


# %% tags=["hide-input"]
def plot_recoveries(controllers):
    """Plot tilt and distance from the target over time, with a cross where a flight ends early."""
    n = len(controllers)
    _, axes = plt.subplots(2, n, figsize=(4.2 * n, 4.6), sharex=True, sharey="row")
    colours = colours_of([*controllers])
    for number, (name, controller) in enumerate(controllers.items()):
        top, bottom = axes[:, number]
        colour = colours[name]
        flights = recorded(controller)
        times = flights["time"]
        _, x, y, _ = np.moveaxis(flights["quaternion"], -1, 0)
        # The angle between the body's z axis and the vertical.
        tilt = np.degrees(np.arccos(np.clip(1 - 2 * (x**2 + y**2), -1, 1)))
        distance = np.linalg.norm(flights["position"] - flights["target"], axis=-1)
        for panel, values in ((top, tilt), (bottom, distance)):
            panel.plot(times, values.T, color=colour, alpha=0.55, linewidth=1)
            for row, samples in zip(values, flights["samples"], strict=True):
                if samples < len(times):
                    last = samples - 1
                    panel.plot(times[last], row[last], "x", color="#1c2430", markersize=5)
        top.set_title(name, loc="left", fontweight="bold")
        bottom.set(xlabel="time (s)", xlim=(0, 6))
    axes[0, 0].set(ylabel="tilt (deg)", yticks=[0, 45, 90, 135, 180])
    axes[1, 0].set(ylabel="distance from the target (m)", ylim=(0, 20))
    plt.show()


# %%
plot_recoveries(
    {
        "PID expert": PIDExpert(),
        "itm-recovery, which comes with the package": load_pretrained("itm-recovery"),
    }
)

# %% [markdown]
# Each line is a flight. Each cross is a crash, or a flight that got out of range. You see that the
# PID controller crashes on most flights that begin upside down: it assumes small angles. The agent
# has learnt to turn over first.
#
# ## Imitate
#
# Now you train an agent of your own. `DAgger` lets it fly and asks the expert what it would have
# done in each state. You use it like any algorithm of Stable-Baselines3. `QuadcopterVecEnv` flies
# all its quadcopters in one compiled call.

# %%
imitation = DAgger(
    "MlpPolicy",
    QuadcopterVecEnv(240, task="target_tracking", seed=0),
    expert=PIDExpert(),
    n_steps=250,
    batch_size=4096,
    gradient_steps=60,
    n_epochs=2,
    learning_rate=LinearSchedule(4e-3, 2e-4, 1.0),
    bc_loss="mse",
    gamma=0.998,
    dataset_capacity=500_000,
    seed=0,
    device="cpu",
)
imitation.learn(IMITATION)
imitation.save("imitation")

# %% [markdown]
# ## Go beyond the expert
#
# So far your agent imitates. `PPOBC` takes it beyond its expert: it is PPO with a cloning term that
# keeps the policy near the expert. With `bc_filter="agreement"` the term ignores states in which
# the agent recovers and the PID would do something else. The callback records the mean reward of
# the last episodes, as any callback of Stable-Baselines3 can.


# %%
class RewardCurve(BaseCallback):
    """Mean reward of the last thousand episodes after each rollout."""

    def _on_training_start(self):
        self.points = []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        rewards = [episode["r"] for episode in self.model.ep_info_buffer]
        mean = np.mean(rewards) if rewards else np.nan
        self.points.append((self.num_timesteps, mean))


agent = PPOBC(
    "MlpPolicy",
    QuadcopterVecEnv(
        480,
        task={"state_recovery": 0.6, "far_tracking": 0.4},
        task_kwargs={"precision_cost": 0.03, "nearest_target": 0.0},
        max_episode_steps=500,
        seed=0,
    ),
    expert=PIDExpert(),
    bc_coef=0.1,
    bc_loss="mse",
    bc_filter="agreement",
    critic_warmup=2,
    n_steps=125,
    batch_size=3750,
    n_epochs=6,
    learning_rate=LinearSchedule(1e-3, 5e-5, 1.0),
    gamma=0.995,
    gae_lambda=0.98,
    policy_kwargs={"log_std_init": -0.9},
    stats_window_size=1000,
    seed=0,
    device="cpu",
)
transfer_policy("imitation.zip", agent)  # policy and critic
curve = RewardCurve()
agent.learn(REINFORCEMENT, callback=curve)
timesteps, rewards = np.array(curve.points).T

# %% tags=["hide-input"]
figure, axes = plt.subplots(figsize=(6.4, 3))
axes.plot(timesteps / 1e6, rewards, color=COLOURS[0])
axes.set(
    xlabel="million timesteps",
    ylabel="mean reward of an episode",
    title="Learning curve",
)
plt.show()

# %% [markdown]
# Do not mind the first points: they come from few and short episodes. In the first two rollouts
# only the critic learns. Then the policy gets better.
#
# Your agent may hover at a small offset from its target. You can correct that without training:
# `correct_offset` measures the offset and takes it out of the first layer.

# %%
correct_offset(agent)
agent.save("my_agent")

# %% [markdown]
# ## Who recovers
#
# All three fly the same fresh episodes, which no training has seen.

# %%
controllers = {"PID expert": PIDExpert(), "imitation agent": imitation, "RL agent": agent}
recoveries = {}
for name, controller in controllers.items():
    recoveries[name] = fly(controller, "state_recovery", EPISODES, seed=1000)
    targets = fly(controller, "target_tracking", EPISODES, seed=1000)
    survival = recoveries[name].survival.mean()
    error = np.median(targets.final_error)
    print(
        f"{name:16} {survival:6.1%} of recoveries survive; "
        f"median final error of targets 10 m away {error:.3f} m"
    )

# %% tags=["hide-input"]
figure, axes = plt.subplots(figsize=(6.4, 3))
times = np.linspace(0, 6, 301)
colours = colours_of([*recoveries])
for name, flights in recoveries.items():
    stable = [(flights.recovery_time <= time).mean() * 100 for time in times]
    axes.plot(times, stable, color=colours[name], label=name, linewidth=2)
axes.set(
    xlabel="time since the start (s)",
    ylabel="flights that are stable (%)",
    xlim=(0, 6),
    ylim=(0, 102),
)
axes.set_title("How soon they are stable again")
axes.legend(loc="lower right")
plt.show()

# %%
plot_recoveries(controllers)

# %% [markdown]
# ## Further
#
# - Stock `PPO` loads your `my_agent.zip`.
# - `sb3-quad demo my_agent.zip pid` writes a page on which you can throw your own agent.
# - `sb3-quad train --thesis` does both trainings with more timesteps, evaluations, snapshots and a
#   table at the end.
