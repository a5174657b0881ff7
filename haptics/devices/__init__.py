"""Devices: motions without hardware, haptic devices, force sensors and stages, real and simulated."""
