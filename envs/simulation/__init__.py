"""n quadcopters as arrays: state, tasks, observation, episodes."""
