"""Three-dimensional solids."""
