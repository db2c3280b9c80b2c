"""Pictures of a formation seen from above. Reads the simulation, never changes it."""
