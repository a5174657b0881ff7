"""Recordings: measured and simulated ones alike, and their files."""
