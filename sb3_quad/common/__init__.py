"""What the algorithms share: expert labels, loss terms and files that are written whole or not at all."""
