"""What the two algorithms share: forward passes and loss terms."""
