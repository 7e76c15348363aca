"""Settings for policies that PX4's module mc_nn_control computes."""
