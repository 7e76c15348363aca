"""A page in which quadcopters fly side by side under several controllers: its sources, and the data
that Python puts into it.
"""
