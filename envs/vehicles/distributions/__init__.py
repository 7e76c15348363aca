"""Vehicle distributions as YAML files; ``simulation/vehicle_distribution.py`` samples from them."""
