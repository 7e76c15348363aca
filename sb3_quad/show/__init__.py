"""Flights to look at: films and windows."""
