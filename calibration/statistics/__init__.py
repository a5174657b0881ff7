"""Noise, jitter, adequacy and uncertainty."""
