"""Sweeps: the same training by many seeds and settings, on one machine or many, compared on the
same fresh episodes.
"""
