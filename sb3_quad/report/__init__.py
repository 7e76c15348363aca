"""A folder of results as one page to read, and each of its figures as a picture."""
