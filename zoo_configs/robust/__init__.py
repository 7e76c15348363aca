"""The agent `itm-robust`, with domain randomization: larger and trained longer than the default."""
