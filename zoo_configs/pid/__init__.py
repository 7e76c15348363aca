"""The two stages of the thesis from its PID expert, with settings that take minutes."""
