"""The compiled engine: threads, memory layout, random numbers, integration. Only its typed functions are used elsewhere."""
