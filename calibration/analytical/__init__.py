"""The analytical calibration: closed forms of homogeneous tests."""
