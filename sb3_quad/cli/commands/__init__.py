"""One module per command. Modules import what takes seconds only when they run."""
