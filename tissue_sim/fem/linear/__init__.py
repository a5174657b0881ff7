"""Linear solvers of the finite elements."""
