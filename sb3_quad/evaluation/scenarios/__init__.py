"""Scenarios as data: what is flown to judge a controller, from YAML files."""
