"""The inverse calibration: simulated tests against measured ones, all at once."""
