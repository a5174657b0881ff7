"""Where the parts of a calibration run."""
