"""Flying controllers over fresh episodes, and the figures and tables that come of it."""
