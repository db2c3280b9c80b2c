"""Pictures of a formation from above; the simulation is only read."""
