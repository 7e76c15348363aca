"""Pictures of flights: vehicles, targets, trails and cameras."""
