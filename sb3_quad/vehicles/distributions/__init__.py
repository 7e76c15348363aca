"""Vehicle distributions as YAML files; ``simulation/designs.py`` samples from them."""
