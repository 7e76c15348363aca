"""The vehicle, its state and its equations of motion: parameters and pure functions over arrays."""
