"""Policies with a memory of their own, for the recurrent algorithms of sb3-contrib."""
