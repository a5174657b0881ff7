"""Demonstration on a virtual specimen: measure, calibrate, predict and diagnose without hardware."""
