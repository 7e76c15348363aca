"""What every floor uses: errors, whole files, signals, seeds."""
