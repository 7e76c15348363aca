"""Flying controllers over fresh episodes, and the metrics and tables that come of it."""
