"""What each command does, a module each; only the one that was called is imported."""
