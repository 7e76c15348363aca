"""What each command does, a module each; what is heavy is imported when it runs."""
