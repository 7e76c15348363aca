"""A folder of results as one page to read, and each of its plots as a picture."""
