"""n quadcopters as arrays: state, tasks, observation, episodes."""

MAX_EPISODE_STEPS = 1500  # 15 s of control steps of 0.01 s (4.2.3)
