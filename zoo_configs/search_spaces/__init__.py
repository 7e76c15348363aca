"""What ``tune`` varies, a file per algorithm."""
