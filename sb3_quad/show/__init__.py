"""Flights to look at: films, sequences of poses in one picture, and PyBullet's window."""
