"""Anything that flies: how it is asked, and how it is read from a zip or found by name."""
