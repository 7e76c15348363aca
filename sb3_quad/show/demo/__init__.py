"""A page in which quadcopters fly under several controllers side by side: its sources, and what
Python puts into it.
"""
