"""The rig: load frame and sensor, between the tissue and the recorded numbers."""
