"""The thesis's training settings as printed (Tables A.3 and A.4)."""
