"""The benchmark: policies × tasks × disturbances × seeds, and its tables."""
