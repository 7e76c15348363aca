"""Scenarios as data: how a controller is judged, from YAML files."""

# The scenarios of the suite thesis, by the task whose episodes they fly.
THESIS_SCENARIOS = {"target_tracking": "tracking", "state_recovery": "recovery"}
