"""Haptic loop at 1 kHz in a separate process."""
