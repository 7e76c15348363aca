"""Settings for one policy that flies any quadcopter, by imitation of the expert that is told each
one.
"""
