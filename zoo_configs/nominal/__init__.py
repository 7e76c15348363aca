"""Settings for one undisturbed vehicle with the geometric expert; agents see 18 features alone."""
