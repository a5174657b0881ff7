"""Materials in other programs: tests that run in a target, and constants that reproduce calibrated forces there."""
