"""Settings for one policy that flies any quadcopter, by imitation of the privileged expert."""
