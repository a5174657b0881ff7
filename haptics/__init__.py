"""Devices and the 1 kHz loop: force sensors, stages, recorder, safety. Empty in this version."""
