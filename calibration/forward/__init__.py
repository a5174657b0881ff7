"""What a test's force is, as a function of the parameters."""
