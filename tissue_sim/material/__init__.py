"""A material: law, parameters, bulk response, and what time, loading and depth do to it."""
