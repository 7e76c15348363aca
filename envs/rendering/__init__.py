"""What is drawn: vehicles, targets, trails, cameras and labels."""
