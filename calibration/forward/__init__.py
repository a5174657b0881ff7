"""Forward models of tests: force as a function of the model parameters."""
