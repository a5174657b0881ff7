"""Load increments of a path, steps of a tool to a pose, and equilibrium under self-weight."""
