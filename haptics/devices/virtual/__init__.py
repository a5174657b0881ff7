"""Simulated devices that need no hardware: a hand, a force sensor, a stage, and a rig with a simulated specimen."""
