"""Closed forms: homogeneous tests, columns under their own weight, and homogeneous tests with history."""
