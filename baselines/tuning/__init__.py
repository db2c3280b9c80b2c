"""The search for a controller's gains, limits and filter parameters."""
