"""Settings for one vehicle in still air, from the geometric expert: agents that see the 18 features
alone.
"""
