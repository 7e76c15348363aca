"""The shipped agent for random worlds, `itm-robust`: larger, and trained for longer, than the
default.
"""
