"""n quadcopters as arrays: state, tasks, observation, episodes."""

# 15 s of control steps of 0.01 s (thesis 4.2.3)
MAX_EPISODE_STEPS = 1500
